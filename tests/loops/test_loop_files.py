"""Closed loops from robot files and Newton models, and the examples that have loops."""

import importlib
import subprocess
import sys

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws, mechanisms
from support.closed_loops import AGREE, DIFFERENCES, both, lagrange
from support.mechanisms import MECHANISMS

FOURBAR = """<mujoco><option gravity="0 0 -9.81"/><default><geom type="capsule" size=".02" density="1000"/></default>
<worldbody>
 <body name="crank"><joint name="a" axis="0 1 0"/><geom fromto="0 0 0 .4 0 0"/>
  <body name="coupler" pos=".4 0 0" euler="0 40 0"><joint name="b" axis="0 1 0"/><geom fromto="0 0 0 .9 0 0"/>
   <body name="rocker" pos=".9 0 0" euler="0 50 0">
   <joint name="c" axis="0 1 0"/><geom fromto="0 0 0 .7 0 0"/></body></body></body>
 <body name="follower" pos="0 1 0"><joint name="d" axis="0 1 0"/><geom fromto="0 0 0 .3 0 0"/></body>
</worldbody><equality>
 <connect name="pin" body1="rocker" anchor=".7 0 0"{second}/><joint joint1="d" joint2="a" polycoef="0.1 -0.5 0 0 0"/>
</equality></mujoco>"""


def test_a_four_bar_from_mjcf(tmp_path, device):
    """connect and a joint equality: the loop is closed where the file's neutral pose has the anchor."""
    (tmp_path / "fourbar.xml").write_text(FOURBAR.format(second=""))
    scene = spo.load(tmp_path / "fourbar.xml")
    assert len(scene.loops) == len(scene.couplings) == 1
    s = mechanisms.states(scene)
    embed, lag = both(scene, 3, device)
    assert len(embed.independent_dofs) == 1
    wanted = lagrange(scene, s)
    one, two = (dyn.forward_dynamics(s.q, s.qd, s.tau, s.body_f) for dyn in (embed, lag))
    assert laws.error(one, wanted) <= DIFFERENCES and laws.error(two, one) <= AGREE


def test_a_four_bar_from_newton(device):
    newton = pytest.importorskip("newton")
    builder = newton.ModelBuilder()
    identity, lengths = wp.quat_identity(), (0.4, 0.9, 0.7)
    bodies = [
        builder.add_link(
            xform=wp.transform_identity(),
            mass=1.0,
            com=wp.vec3(0.5 * length, 0.0, 0.0),
            inertia=wp.mat33(np.diag([0.01, 0.1, 0.1])),
        )
        for length in lengths
    ]
    joints = []
    for k, body in enumerate(bodies):
        place = wp.transform((lengths[k - 1] if k else 0.0, 0.0, 0.0), identity)
        joints.append(builder.add_joint_revolute(bodies[k - 1] if k else -1, body, parent_xform=place, axis=(0, 1, 0)))
    builder.add_articulation(joints)
    builder.add_joint_revolute(
        -1,
        bodies[2],
        parent_xform=wp.transform((1.0, 0.0, 0.0), identity),
        child_xform=wp.transform((0.7, 0.0, 0.0), identity),
        axis=(0, 1, 0),
    )
    scene = spo.from_newton(builder.finalize(device="cpu"))
    s = mechanisms.states(scene)
    one, two = (dyn.forward_dynamics(s.q, s.qd, s.tau, s.body_f) for dyn in both(scene, 3, device))
    wanted = lagrange(scene, s)
    assert laws.error(one, wanted) <= DIFFERENCES and laws.error(two, one) <= AGREE


def biped_file():
    """The example's biped as MJCF: nested bodies, hinges one by one, a connect for each rod."""
    scene = MECHANISMS["biped"]()
    children = {k: [] for k in range(-1, scene.body_count)}
    for hinge in scene.hinges:
        children[hinge.parent].append(hinge)

    def written(hinge):
        k = hinge.child
        body = scene.bodies[k]
        pose, quat = hinge.parent_pose[:3], np.roll(hinge.parent_pose[3:], 1)
        numbers = lambda values: " ".join(f"{x:.17g}" for x in values)  # noqa: E731
        text = f'<body name="b{k}" pos="{numbers(pose)}" quat="{numbers(quat)}">'
        inertia = numbers(np.diag(body.inertia))
        text += f'<inertial pos="{numbers(body.com)}" mass="{body.mass}" diaginertia="{inertia}"/>'
        text += f'<freejoint name="j{k}"/>' if hinge.kind == "free" else ""
        for i, (axis, _, _) in enumerate(hinge.screws):
            text += f'<joint name="j{k}_{i}" axis="{numbers(axis)}" armature="{hinge.armature[i]}"/>'
        return text + "".join(map(written, children[k])) + "</body>"

    connects = "".join(
        f'<connect body1="b{loop.parent}" body2="b{loop.child}" anchor="{" ".join(map(str, loop.parent_pose[:3]))}"/>'
        for loop in scene.loops
    )
    bodies = "".join(map(written, children[-1]))
    return f"<mujoco><worldbody>{bodies}</worldbody><equality>{connects}</equality></mujoco>"


@pytest.mark.slow
def test_a_biped_from_a_robot_file(tmp_path, device):
    """The example's biped, through a file: the same loops, and both ways of closing them agree."""
    (tmp_path / "biped.xml").write_text(biped_file())
    scene = spo.load(tmp_path / "biped.xml")
    assert scene.dof_count == 30 and [loop.kind for loop in scene.loops] == ["ball"] * 4
    s = mechanisms.states(scene, 2)
    embed, lag = both(scene, 2, device)
    assert len(embed.independent_dofs) == 18
    one, two = (dyn.forward_dynamics(s.q, s.qd, s.tau, s.body_f) for dyn in (embed, lag))
    assert laws.error(one, lagrange(scene, s)) <= DIFFERENCES and laws.error(two, one) <= AGREE


@pytest.mark.parametrize("name", ["fourbar", "fivebar", "slider_crank", "stewart", "biped", "gripper"])
def test_an_example_runs(name, capsys):
    module = importlib.import_module(f"warp_spo.examples.{name}")
    assert len(open(module.__file__).read().splitlines()) < 100
    if name in ("fourbar", "stewart", "biped"):
        module.main(seconds=0.02)
    else:
        module.main()
    assert "nan" not in capsys.readouterr().out


def test_examples_are_modules():
    command = [sys.executable, "-m", "warp_spo.examples.gripper"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "5 dofs, 2 independent: wrist, left finger" in done.stdout
