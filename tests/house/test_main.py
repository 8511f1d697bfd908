"""The main job, ``python -m warp_spo``: its table, its report, its exit codes."""

import base64
import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from warp_spo import Dynamics
from warp_spo import __main__ as job
from warp_spo.trials import drop_test, memory, report, trial
from warp_spo.trials.inputs import OPERATIONS, TOLERANCE

# Two bars on the ground whose tips are pinned together: a loop.
LOOP = """<mujoco><default><geom size=".03"/></default><worldbody>
<body name="a"><joint name="j0" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 .4"/>
  <body name="b" pos="0 0 .4"><joint name="j1" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .4 0 0"/></body>
</body>
<body name="c" pos=".4 0 0"><joint name="j2" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 .4"/></body>
</worldbody><equality><connect name="pin" body1="b" body2="c" anchor=".4 0 0"/></equality></mujoco>"""


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(job, "WARM_UP", 0.0)
    monkeypatch.setattr(job, "BUDGET", 0.0)


def test_reports_every_operation_in_both_precisions(tmp_path, capsys, device):
    assert job.main(["cartpole", "--worlds", "3", "--device", str(device), "--report", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert err == ""  # not a terminal: no bar
    said = f"PASSED: {len(OPERATIONS)} operations, {2 * len(OPERATIONS)} results, all within tolerance"
    assert said in out.splitlines() and f"run {len(OPERATIONS)} operations" in job.__doc__
    lines = [line.split() for line in out.splitlines() if " float" in line and "tolerance" not in line]
    assert [tuple(line[:3:2]) for line in lines] == [(op, dtype) for op in OPERATIONS for dtype in TOLERANCE]
    for _, _, dtype, error, *_ in lines:
        assert 0.0 <= float(error) <= TOLERANCE[dtype]
    (page,) = tmp_path.iterdir()
    text = page.read_text()
    assert text.startswith("<!doctype html>") and text.count("<td>phi.T</td>") == 2
    assert [line[3] for line in lines] == re.findall(r"<td>float\d\d</td><td>(.*?)</td>", text)
    (picture,) = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', text)
    assert "largest relative error" in base64.b64decode(picture).decode()
    assert "http" not in text.replace(picture, "")  # nothing to fetch


def test_a_robot_that_cannot_move_passes(tmp_path, capsys, device):
    robot = tmp_path / "block.urdf"
    robot.write_text(
        '<robot name="r"><link name="a"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    assert job.main([str(robot), "--worlds", "2", "--device", str(device)]) == 0
    assert "FAILED" not in capsys.readouterr().err


@pytest.mark.parametrize("summed", [2, 5, 6, 7])
@pytest.mark.parametrize("entry", [0, 3, 5])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_single_entry_that_is_not_finite_is_found(monkeypatch, device, summed, entry, value):
    monkeypatch.setattr(trial, "MOST_SUMMED", summed)  # sums of arrays with more entries are taken in parts
    numbers = np.ones((3, 2))
    assert trial.all_finite(wp.array(numbers, dtype=wp.float32, device=device))
    numbers.flat[entry] = value
    assert not trial.all_finite(wp.array(numbers, dtype=wp.float32, device=device))


def test_a_wrong_result_fails_and_is_named(capsys, monkeypatch, device):
    wrong = dataclasses.replace(OPERATIONS["gravity_force"], reference=lambda dense, q: 1.001 * dense.gravity_force)
    nothing = dataclasses.replace(OPERATIONS["mass_matrix"], call=lambda *inputs, out: None)
    chosen = {"phi": OPERATIONS["phi"], "gravity_force": wrong, "mass_matrix": nothing}
    monkeypatch.setattr(job, "OPERATIONS", chosen)
    assert job.main(["cartpole", "--worlds", "2", "--dtype", "float64", "--device", str(device)]) == 1
    out, err = capsys.readouterr()
    assert out.splitlines()[-1] == "FAILED: 3 operations, 3 results, 2 beyond tolerance"
    failed = [line for line in err.splitlines() if line.startswith("FAILED")]
    assert len(failed) == 2
    assert "gravity_force in float64 has error 1.0e-03; expected at most 1e-10" in failed[0]
    assert "mass_matrix in float64 gives NaN" in failed[1]


def test_notes_about_what_a_file_has_besides_say_that_it_is_no_fault(tmp_path, capsys):
    (tmp_path / "robot.xml").write_text(
        '<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>'
        '<sensor><jointpos joint="j"/></sensor></mujoco>'
    )
    job.load(str(tmp_path / "robot.xml"))
    (note,) = capsys.readouterr().err.splitlines()
    assert (
        "left out: " in note and "1 sensor" in note and note.endswith("(no fault: the comparison needs nothing of it)")
    )


def test_loops_are_cut_and_named(tmp_path, capsys, monkeypatch, device):
    monkeypatch.setattr(job, "OPERATIONS", {"mass_matrix": OPERATIONS["mass_matrix"]})
    (tmp_path / "loop.xml").write_text(LOOP)
    assert job.main([str(tmp_path / "loop.xml"), "--worlds", "2", "--device", str(device)]) == 0
    assert "left open: 1 loop joint(s): pin" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("loops", "says"),
    [
        ("embed", "closed by embed: 1 loop joint(s): pin"),
        ("multipliers", "closed by multipliers: 1 loop joint(s): pin"),
    ],
)
def test_loops_are_closed(tmp_path, capsys, monkeypatch, device, loops, says):
    chosen = ("forward_dynamics", "body_poses", "mass_matrix", "psi")
    monkeypatch.setattr(job, "OPERATIONS", {name: OPERATIONS[name] for name in chosen})
    (tmp_path / "loop.xml").write_text(LOOP)
    arguments = [str(tmp_path / "loop.xml"), "--worlds", "2", "--device", str(device), "--dtype", "float64"]
    assert job.main([*arguments, "--loops", loops, "--report", str(tmp_path)]) == 0
    out, page = capsys.readouterr().out, (tmp_path / job.REPORT).read_text()
    left = {"embed": "forward_dynamics, mass_matrix, psi", "multipliers": "forward_dynamics, psi"}[loops]
    assert says in out and f"not compared: {left}\n" in out and re.search(r"^body_poses ", out, re.M)
    kept = {"embed": "body_poses", "multipliers": "body_poses, mass_matrix"}[loops]
    assert f"With --loops {loops} only these are compared" in out and f"no dense reference here: {kept}\n" in out
    assert f"no dense reference here: {kept}</p>" in page and f"not compared: {left}</p>" in page
    assert job.main([*arguments, "--loops", "raise"]) == 2
    err = capsys.readouterr().err
    assert "loop.xml' has 1 loop joint(s): pin, which --loops raise refuses; pass --loops cut, embed" in err


def test_the_help_names_what_is_compared_where_loops_are_embedded():
    forms = {name: one.embed for name, one in job.DECLARED.items() if name not in job.CLOSED}
    kept = sorted(name for name in OPERATIONS if forms.get(name) is job.AS_WRITTEN)
    said = re.search(r"with embed only (.*) and (\w+), because", " ".join(job.parser().format_help().split()))
    assert [*said[1].split(", "), said[2]] == kept


def test_worlds_that_do_not_fit_are_refused_before_they_are_allocated(capsys, monkeypatch, device):
    """The largest number of worlds that the message names is taken."""
    monkeypatch.setattr(job, "OPERATIONS", {"gravity_force": OPERATIONS["gravity_force"]})
    assert job.main(["cartpole", "--worlds", "2000000000", "--device", str(device)]) == 2
    assert "--worlds is 2000000000: this needs about" in capsys.readouterr().err
    monkeypatch.setattr(memory, "free_host_memory", lambda: 100_000)
    assert job.main(["cartpole", "--worlds", "1000", "--device", str(device)]) == 2
    most = re.search(r"pass --worlds (\d+) or fewer", capsys.readouterr().err)[1]
    assert 5 < int(most) < 100
    assert job.main(["cartpole", "--worlds", most, "--device", str(device)]) == 0


def test_the_estimate_of_memory_is_about_what_warp_allocates(capsys):
    """The estimate is for the whole job; it may be above the peak, and hardly below."""
    worlds, reports = 1000, []
    scene = job.load("cartpole")
    with wp.ScopedMemoryTracker("job", report_func=reports.append) as tracker:
        tracker.clear()  # totals are Warp's own, not this tracker's
        dyn = Dynamics(scene, worlds, "cpu", "float32")
        list(job.run([dyn]))
    number, unit = re.search(r"Peak usage:\s+cpu\s+([\d.]+) (\w+)", reports[-1]).groups()
    peak = float(number) * {"KB": 2**10, "MB": 2**20}[unit]
    _, on_device = memory.bytes_per_world(scene, ("float32",), 1)
    assert 0.95 <= on_device * worlds / peak <= 1.3  # 1.03 here
    capsys.readouterr()


BAD_FILES = {
    "broken.urdf": ('<robot name="x"><link name="a"></robot>', "is not XML: mismatched tag: line 1"),
    "broken.xml": ("<mujoco><worldbody><body></worldbody></mujoco>", "is not XML: mismatched tag: line 1"),
    "page.xml": ("<html/>", "holds <html>; expected <mujoco>"),
    "empty.xml": ("<mujoco><worldbody/></mujoco>", "has no bodies"),
    "empty.usda": ("#usda 1.0", "has no rigid bodies"),
    "text.usda": ("hello", "is not a valid usda layer"),
    "part.stl": ("solid", "ends in '.stl'; expected one of .urdf, .xml"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_one_line_about_the_file(tmp_path, capfd, name):
    text, expected = BAD_FILES[name]
    (tmp_path / name).write_text(text)
    assert job.main([str(tmp_path / name), "--worlds", "2"]) == 2
    line = capfd.readouterr().err.splitlines()[-1]
    assert line.startswith("python -m warp_spo: ") and f"{name}'" in line and expected in line
    assert not any(word in line for word in ("load:", "from_newton", "Traceback", "pxrInternal"))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([os.path.dirname(__file__)], "is a folder; expected a URDF, MJCF or USD file"),
        (["no_such_robot"], "expected one of humanoid, ant, quadruped, cartpole"),
        (["no/such/file.urdf"], "no file 'no/such/file.urdf'"),
        ([__file__], "ends in '.py'"),
        (["cartpole", "--worlds", "0"], "worlds is 0; expected 1 to 2147483647"),
        (["cartpole", "--worlds", "99999999999"], "worlds is 99999999999; expected 1 to 2147483647"),
        (["panda", "--ground"], "--ground with 'panda'; expected one of ant, go2, g1"),
        (["ant", "--ground", "--worlds", "3"], "--worlds with --ground; expected one of them"),
        (["cartpole", "--device", "abacus"], "--device is 'abacus'; expected one of this machine's devices: cpu"),
    ],
)
def test_mistakes_are_one_line(arguments, expected, capsys):
    assert job.main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and expected in err


def test_a_robot_falls_onto_the_ground(tmp_path, capsys, device):
    """In the end four feet carry an ant; the strip has a picture for each row of the table."""
    from PIL import Image

    assert job.main(["ant", "--ground", "--device", str(device), "--report", str(tmp_path)]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith(" ")]
    times, heights, loads, points = (np.array([float(row[i]) for row in rows]) for i in range(4))
    assert len(rows) == drop_test.FRAMES and (np.diff(times) > 0.0).all() and heights[0] > heights[-1] + 0.25
    assert loads[0] == 0.0 and abs(loads[-1] - 1.0) <= 0.02 and points[-1] == 4
    with Image.open(tmp_path / "ground.png") as strip:
        shown = np.asarray(strip).astype(int)
    width, red = shown.shape[1] // len(rows), shown[..., 0] > 2.5 * shown[..., 1]
    assert not red[:, :width].any() and red[:, -width:].sum() > 50  # forces


def test_a_mistaken_option_is_one_line(capsys):
    with pytest.raises(SystemExit, match="2"):
        job.main(["--worlds", "many"])
    assert capsys.readouterr().err.count("\n") == 1


def test_missing_matplotlib_names_the_extra(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert job.main(["cartpole", "--worlds", "2", "--report", str(tmp_path / "report")]) == 2
    err = capsys.readouterr().err
    assert "pip install warp_spo[plots]" in err and err.count("\n") == 1
    assert not (tmp_path / "report").exists()


def test_a_folder_that_cannot_be_made_is_named(tmp_path, capsys):
    (tmp_path / "file").touch()
    assert job.main(["cartpole", "--worlds", "2", "--report", str(tmp_path / "file")]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and f"--report is '{tmp_path}" in err and "expected a folder" in err


def test_runs_as_a_module():
    root = Path(job.__file__).parent.parent
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", "warp_spo", "no_such_robot"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and done.stdout == ""
    assert "Traceback" not in done.stderr and "unknown robot 'no_such_robot'" in done.stderr


def test_numbers_have_three_digits_and_a_unit():
    values = [2.0, 0.0345, 1.0e-3, 999.6e-6, 4.2e-6, 5.0e-8]
    assert [report.duration(v) for v in values] == ["2.00 s", "34.5 ms", "1.00 ms", "1.00 ms", "4.20 us", "50.0 ns"]
    assert [report.rate(v) for v in (14.2e9, 3.0e6, 999.0, 12.0)] == ["14.2 G", "3.00 M", "999", "12.0"]
