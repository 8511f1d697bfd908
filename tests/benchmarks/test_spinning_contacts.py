"""benchmarks.contact.spinning_contacts: a sphere of one size, and what counts as a fault."""

from benchmarks.contact import spinning_contacts


def test_a_short_form_has_no_fault(monkeypatch):
    monkeypatch.setattr(spinning_contacts, "SECONDS", 1.0)
    monkeypatch.setattr(spinning_contacts, "RATIOS", (100,))
    ours, theirs = spinning_contacts.rows((0.1,), (5e-3,), ("float64",))
    assert not spinning_contacts.fault(ours)
    assert theirs["solver"] == "MuJoCo, impratio 100" and theirs["spins"] < 0.02
    assert spinning_contacts.fault(ours | {"rolls": 0.1}) == "rolls"
    assert spinning_contacts.fault(ours | {"rolls, left": 0.1}) == "rolls, left"
    assert spinning_contacts.fault(ours | {"stands, 0.9 of the bound": 0.1}) == "stands, 0.9 of the bound"
