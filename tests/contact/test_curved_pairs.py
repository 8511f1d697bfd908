"""Cylinders and ellipsoids of a file touch other bodies: they rest, lie on each other and are held."""

import numpy as np
import pytest

import warp_spo as spo

SINK = 2e-4  # what rests sinks by 0.1 mm under the load that may stand on it [m]
FILE = """<mujoco><worldbody><geom name="table" type="box" size=".6 .3 .02" pos="0 0 .02"/>
  <body name="can" pos="0 0 .09"><freejoint/><geom type="cylinder" size=".03 .05" mass=".3"/></body>
  <body name="top" pos="0 0 .17"><freejoint/><geom type="cylinder" size=".02 .03" mass=".1"/></body>
  <body name="roll" pos=".2 0 .07" quat=".7071068 .7071068 0 0"><freejoint/>
    <geom type="cylinder" size=".03 .05" mass=".3"/></body>
  <body name="egg" pos="-.2 0 .06"><freejoint/><geom type="ellipsoid" size=".04 .03 .02" mass=".2"/></body>
  <body name="pea" pos="-.4 0 .05"><freejoint/><geom type="sphere" size=".01" mass=".05"/></body>
</worldbody></mujoco>"""
REST = {"can": 0.09, "top": 0.17, "roll": 0.07, "egg": 0.06, "pea": 0.05}  # heights [m]
DT, STEPS = 5e-3, 200


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    file = tmp_path_factory.mktemp("curved") / "cans.xml"
    file.write_text(FILE)
    with pytest.warns(UserWarning, match="ground=spo.Plane.. adds a floor"):
        return spo.load(file, contacts=True)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_what_is_round_rests(scene, dtype, device):
    """Nothing given but the file: heights and weights are those of the closed form, and nothing rolls away."""
    dyn = spo.Dynamics(scene, worlds=2, dtype=dtype, device=device)
    assert "joint space" in dyn.explain()
    q, qd = np.tile(scene.initial_q, (2, 1)), np.zeros((2, scene.dof_count))
    status, force = np.zeros(2, np.int32), np.zeros((2, len(scene.contact_pairs), 3), dtype)
    for _ in range(STEPS):
        q, qd = dyn.step(q, qd, None, DT, status=status, report=spo.StepReport(contact_f=force))
        assert not status.any()
    poses = np.asarray(dyn.body_poses(q))
    bodies = scene.body_labels
    for name, height in REST.items():
        assert np.abs(poses[:, bodies.index(name), 2] - height).max() < SINK, name
    assert np.abs(np.asarray(qd)).max() < 2e-3
    on = {name: np.zeros(2) for name in REST}
    for at, pair in enumerate(scene.contact_pairs):
        for body, sign in ((pair.body, 1.0), (pair.other, -1.0)):
            if body >= 0:
                on[bodies[body]] += sign * force[:, at, 2]
    for name, up in on.items():
        weight = 9.81 * scene.values["body_mass"][0, bodies.index(name)]
        assert np.abs(up - weight).max() < 1e-2 * weight, name


def test_what_no_step_takes_is_refused_with_the_way_out():
    """A disc has no length, a cone no routine, and torsional friction of the ground is not in joint space."""
    box, can = spo.Contact(1, box=(0.1, 0.1, 0.1)), dict(cylinder=((0, 0, -0.1), (0, 0, 0.1), 0.05))
    body = spo.Body(1.0, inertia=0.01 * np.eye(3))
    two = spo.Scene([body, body], [spo.Hinge("free", -1, 0), spo.Hinge("free", -1, 1)])
    for shape, message in (
        (dict(cone=((0, 0, 0), (0, 0, 0.1), 0.05)), "a cone in contact with another body .* a cylinder, an ellipsoid"),
    ):
        with pytest.raises(spo.UnsupportedError, match=message):
            two.with_contacts([spo.Contact(0, other=box, **shape)])
    turning = two.with_contacts([spo.Contact(0, other=box, **can), spo.Contact(1, sphere=0.1, torsional_friction=0.01)])
    dyn = spo.Dynamics(turning)
    with pytest.raises(
        spo.UnsupportedError,
        match=r"scene with torsional friction .*; set contact_torsional_friction to zero.*capsules",
    ):
        dyn.step(two.neutral_q[None], np.zeros((1, 12)), None, DT)
