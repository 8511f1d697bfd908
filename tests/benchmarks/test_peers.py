"""Peers of the benchmarks: the lumped robot, conventions, files of the harnesses, and every peer that is installed."""

import json
import stat
import sys
from pathlib import Path

import numpy as np
import pytest

import warp_spo as spo
from benchmarks import peers
from benchmarks.peers import coordinates, exchange, lumped
from benchmarks.peers.__main__ import main
from benchmarks.peers.peer import Absent
from benchmarks.table import cases, robots
from support import zoo
from warp_spo.trials.inputs import TOLERANCE, Inputs

WORLDS = 3
FLOAT64_MAP = 1e-12  # of a state of size one, mapped there and back
STEP = 1e-3  # (qd after - qd before) / dt of a float32 step: Newton's reach 1e-4
NAMES = {"forward_dynamics": "qdd", "inverse_dynamics": "tau", "mass_matrix": "M"}


def standing_arm():
    """Three moving links on oblique anchors, with bodies fixed before, between and behind them."""
    rng = np.random.default_rng(1)
    kinds = ["fixed", "revolute", "fixed", "prismatic", "revolute", "fixed"]
    hinges = [
        spo.Hinge(kind, k - 1, k, parent_pose=zoo.random_pose(rng), child_pose=zoo.random_pose(rng, 0.2),
                  **({} if kind == "fixed" else {"axis": zoo.unit(rng, 3)}))
        for k, kind in enumerate(kinds)
    ]  # fmt: skip
    return spo.Scene([zoo.random_body(rng, f"body_{k}") for k in range(len(kinds))], hinges)


SCENES = {"arm": standing_arm, "quadruped": cases.SCENES["quadruped"]}
SMALL = list(SCENES)
SCENES |= {name: cases.SCENES[name] for name in robots.ROBOTS if robots.is_available(name)}


@pytest.fixture(scope="module", params=SCENES)
def robot(request):
    return lumped.lump(SCENES[request.param]())


@pytest.fixture(scope="module", params=SMALL)
def small_robot(request):
    """Where every peer compiles its kernels."""
    return lumped.lump(SCENES[request.param]())


def inputs(robot, worlds=WORLDS):
    return [Inputs(robot.scene, worlds, seed) for seed in range(2)]


def installed(name):
    module = pytest.importorskip(f"benchmarks.peers.{peers.PEERS[name]}")
    try:
        module.PEER.version()
    except Absent as reason:
        pytest.skip(str(reason))
    return module.PEER


@pytest.mark.parametrize("twist", coordinates.TWISTS)
def test_states_come_back_from_a_peer(robot, twist):
    state = {name: inputs(robot)[0].array(name).astype(np.float64) for name in ("q", "qd", "tau", "qdd")}
    own = coordinates.Coordinates(robot, twist, scalar_first=twist == "mixed")
    back = own.to_scene(own.to_peer(*state.values()))
    for name, array in state.items():
        np.testing.assert_allclose(back[name], array, atol=FLOAT64_MAP, err_msg=name)


def test_power_is_the_same_in_every_convention(robot):
    q, qd, tau, qdd = (inputs(robot)[0].array(name).astype(np.float64) for name in ("q", "qd", "tau", "qdd"))
    for twist in coordinates.TWISTS:
        own = coordinates.Coordinates(robot, twist).to_peer(q, qd, tau, qdd)
        np.testing.assert_allclose((own["tau"] * own["qd"]).sum(1), (tau * qd).sum(1), rtol=FLOAT64_MAP)


@pytest.mark.parametrize("op", NAMES)
def test_mujoco_has_the_same_robot(robot, op):
    """In float64: lumping, orders and the convention of a floating root, by another hand than the reference's."""
    kind = installed("mujoco")
    peer = kind(robot, "cpu", "float64")
    states = coordinates.States(peer.coordinates, inputs(robot), "float64")
    peer.prepare(op, "", states, WORLDS)
    for index in range(2):
        peer.poison()
        peer.run(index)
        assert states.error(op, index, [0, 2], peer.result([0, 2])) < TOLERANCE["float64"]
    if robot.floating:
        wrong = coordinates.States(coordinates.Coordinates(robot, "local", True), inputs(robot), "float64")
        peer.prepare(op, "", wrong, WORLDS)
        peer.run(0)
        assert wrong.error(op, 0, [0], peer.result([0])) > 1e-3


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name == "newton" else ())  # compiles for a minute
        for name in peers.PEERS
        if name not in ("mujoco", "pinocchio", "grid")
    ],
)
def test_peers_compute_what_the_reference_says(small_robot, name, device):
    kind = installed(name)
    for dtype in kind.dtypes:
        try:
            peer = kind(small_robot, str(device), dtype)
        except (Absent, lumped.Unsupported) as reason:
            pytest.skip(str(reason))
        rows = list(peer.rows(inputs(small_robot), [1, WORLDS], lambda op, variant: True))
        assert len(rows) == 2 * len(kind.works)
        for row in rows:
            limit = STEP if row["variant"].startswith("Solver") else TOLERANCE[dtype]
            assert row["error"] < limit and 0.0 < row["p10_us"] <= row["us"] <= row["p90_us"], row


def test_lumped_urdf_is_the_same_robot(robot, tmp_path):
    file = tmp_path / "robot.urdf"
    file.write_text(lumped.urdf(robot))
    again = lumped.lump(spo.load(file, floating=robot.floating))
    assert [link.parent for link in again.links] == [link.parent for link in robot.links]
    for one, other in zip(again.links, robot.links, strict=True):
        for name in ("rotation", "place", "axis", "mass", "com", "inertia"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-6, err_msg=name)


def test_what_peers_cannot_have_is_refused():
    with pytest.raises(lumped.Unsupported, match="armature"):
        lumped.lump(cases.SCENES["arm7"]())
    with pytest.raises(lumped.Unsupported, match=r"hinge 0 is ball; expected fixed, revolute"):
        lumped.lump(spo.Scene([spo.Body(1.0)], [spo.Hinge("ball", -1, 0)]))


HARNESS = """#!{python}
import json, sys
import numpy as np
import warp as wp
wp.config.log_level = wp.LOG_WARNING
sys.path.insert(0, {root!r})
import warp_spo as spo
states, results, *worlds = sys.argv[1:]
raw = open(states, "rb").read()
size, sets, count, nq, nv = np.frombuffer(raw, "<i4", 5).tolist()
numbers, at = np.frombuffer(raw, "<f8", offset=20), 0
def take(n):
    global at
    at += count * n
    return numbers[at - count * n : at].reshape(count, n)
each = [[take(n) for n in (nq, nv, nv, nv)] for _ in range(sets)]
dyn = spo.Dynamics(spo.load({urdf!r}), count, "cpu", "float64")
offset = 0
with open(results, "wb") as file:
    for count in map(int, worlds):
        sample = sorted({{0, min(1, count - 1), count // 2, count - 1}})
        for i in [*range(sets), sets - 1]:
            q, qd, tau, _ = each[i]
            file.write(dyn.forward_dynamics(q, qd, tau)[sample].tobytes())
        print(json.dumps(dict(op="forward_dynamics", variant="", worlds=count, us=1.0, offset=offset, size=nv)))
        offset += (sets + 1) * len(sample) * nv
"""


def test_harnesses_read_states_and_give_results(tmp_path):
    """By a harness in Python, on a robot whose coordinates are the scene's."""
    rng = np.random.default_rng(2)
    inertia, axes = np.diag([0.02, 0.03, 0.04]), np.eye(3)
    bodies = [spo.Body(1.0 + k, rng.normal(size=3), inertia) for k in range(3)]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=axes[k], parent_pose=(0, 0.5, 0, 0, 0, 0, 1)) for k in range(3)]
    robot = lumped.lump(spo.Scene(bodies, hinges))
    file, script = tmp_path / "robot.urdf", tmp_path / "harness"
    file.write_text(lumped.urdf(robot))
    root = str(Path(spo.__file__).parent.parent)
    script.write_text(HARNESS.format(python=sys.executable, root=root, urdf=str(file)))
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    states = coordinates.States(coordinates.Coordinates(robot), inputs(robot, 5), "float64")
    exchange.write_states(tmp_path / "states", states)
    command = [str(script), str(tmp_path / "states"), str(tmp_path / "results"), "1", "5"]
    rows = list(exchange.rows(command, tmp_path / "results", states, timeout=60))
    assert [row["worlds"] for row in rows] == [1, 5]
    assert all(row["error"] < 1e-5 for row in rows)  # Newton's importer rounds the URDF's numbers to float32
    exchange.write_model(tmp_path / "model", robot)
    model = np.fromfile(tmp_path / "model", dtype="<f8", offset=4 + 24).reshape(3, 30)
    assert model[:, 0].tolist() == [-1, 0, 1] and np.allclose(model[:, 17], [1, 2, 3])
    with pytest.raises(RuntimeError, match="returned"):
        list(exchange.rows([sys.executable, "-c", "raise SystemExit(3)"], tmp_path / "results", states, timeout=60))


@pytest.mark.slow
def test_command_writes_rows_and_skips_what_is_absent(tmp_path, capsys, monkeypatch):
    installed("newton")
    monkeypatch.delenv("WARP_SPO_PEERS", raising=False)
    out = tmp_path / "run.json"
    call = ["quadruped.mass_matrix", "--peers", "grid", "newton", "--scenes", "quadruped", "--worlds", "2"]
    assert main([*call, "--device", "cpu", "--json", str(out)]) == 0
    (row,) = json.loads(out.read_text())["rows"]
    assert row["peer"].startswith("Newton 1.") and row["op"] == "mass_matrix" and row["dof"] == 18
    assert row["work"] and row["error"] < TOLERANCE["float32"]
    assert row["evals_per_s"] == pytest.approx(2e6 / row["us"], rel=1e-3)
    printed = capsys.readouterr()
    assert "skipped grid: WARP_SPO_PEERS names no folder" in printed.err
    assert ".quadruped.mass_matrix.eval_mass_matrix.float32.w2.us" in printed.out


def test_a_peer_that_fails_leaves_the_others(capsys, monkeypatch):
    kind = installed("newton")
    monkeypatch.setattr(kind, "prepare", lambda *args: 1 / 0)
    call = ["mass_matrix", "--peers", "newton", "mujoco", "--scenes", "quadruped", "--worlds", "1", "--device", "cpu"]
    assert main(call) == 0
    printed = capsys.readouterr()
    assert "ZeroDivisionError" in printed.err
    assert "MuJoCo-C" in printed.out


def test_a_robot_that_is_not_installed_says_how_to_get_it(monkeypatch, tmp_path):
    monkeypatch.setenv(robots.FOLDER, str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"expected go2\.urdf"):
        cases.SCENES["go2"]()
    monkeypatch.delenv(robots.FOLDER)
    monkeypatch.setattr(robots, "PACKAGE", "no-such-package")
    with pytest.raises(ImportError, match=r"pip install warp_spo\[robots\]"):
        cases.SCENES["go2"]()
