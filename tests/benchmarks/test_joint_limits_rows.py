"""benchmarks.joint_limits: one law, and what counts as a fault."""

from benchmarks import joint_limits

ROW = {"solimplimit": joint_limits.DEFAULT, "share": [0.5, 0.6, 1.1, 2.0]}


def test_a_law_and_its_faults(monkeypatch):
    monkeypatch.setattr(joint_limits, "JOINTS", {"slide": joint_limits.JOINTS["slide"]})
    monkeypatch.setattr(joint_limits, "REFERENCES", {".02 1": 1e-3})
    monkeypatch.setattr(joint_limits, "IMPEDANCES", (".99 .99 .01",))
    (row,) = joint_limits.rows()
    assert max(abs(share - 1.0) for share in row["share"]) < 1e-3 and not joint_limits.fault(row)
    assert not joint_limits.fault(ROW)
    assert joint_limits.fault(ROW | {"share": [0.5, 0.6, 1.3, 2.0]}) == "its own weight"
    assert joint_limits.fault(ROW | {"share": [1.0, 1.0, float("nan"), 1.0]}) == "its own weight"
    assert joint_limits.fault(ROW | {"share": [0.3, 0.6, 1.0, 2.0]}) == "other loads"
    assert not joint_limits.fault(ROW | {"share": [0.1, 0.6, 1.0, 9.0], "solimplimit": "0 .99 .1"})
