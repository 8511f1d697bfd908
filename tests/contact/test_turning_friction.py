"""Torsional and rolling friction of contacts with the ground: closed forms, the dense step, MuJoCo, files, refusals."""

import functools

import mujoco
import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import contact_gradients
from support.contact_cases import box, quadruped, quadruped_case, rise, touching
from support.contact_steps import FIELDS, H, above, assert_is_dense, by_point, with_turning
from warp_spo.reference import contact as reference
from warp_spo.reference.contact import ContactStep
from warp_spo.scene.contact_values import TURNING_VALUES

torch = pytest.importorskip("torch")
RADIUS, G = 0.1, 9.81
TURN = 0.4 * RADIUS**2  # inertia of a solid sphere of 1 kg [kg m^2]
SPIN, ROLL = 5e-3, 2e-3  # coefficients [m]
REPORTS = ("contact_f", "contact_moment", "contact_excess")
EXACT = {"float64": 1e-12, "float32": 1e-5}  # of a rate that nothing changes
SLOWING = 2e-3  # of what a moment takes off: the secant of three passes, 8e-4 measured at 10 ms; a damper at low rates
STOPPED = {"float64": 1e-6, "float32": 2e-5}  # rates [rad/s, m/s] and moments [N m] of what has stopped
ROUNDING = 1e-11  # of the energy before, as in test_contact_reference


def sphere(**contact):
    """A solid sphere of 1 kg on a plane."""
    body = spo.Body(1.0, inertia=TURN * np.eye(3))
    return spo.Scene([body], [spo.Hinge("free", -1, 0)], contacts=[spo.Contact(0, sphere=RADIUS, **contact)])


@functools.cache
def compiled(dtype, device):
    """A step of spheres whose worlds have their own coefficients and their own slope, by a tilted gravity."""
    return spo.Dynamics(sphere(), 4, device, dtype, variable=("gravity", *TURNING_VALUES))


def run(spin, roll, qd, seconds, h=H, slope=0.0, dtype="float64", device="cpu"):
    """Rates after each step [step, world, dof] of spheres at rest but for ``qd``, and the last report and status.

    Coefficients, rates and slopes are those of each of four worlds, or of all.
    """
    dyn, scene = compiled(dtype, str(device)), sphere()
    column = lambda x: np.broadcast_to(np.reshape(x, (-1, 1)), (4, 1)).astype(dtype)  # noqa: E731
    tilt = np.arctan(column(slope))
    gravity = G * np.hstack([np.sin(tilt), 0.0 * tilt, -np.cos(tilt)])
    dyn.set(
        contact_torsional_friction=column(spin), contact_rolling_friction=column(roll), gravity=gravity.astype(dtype)
    )
    q = np.tile([0.0, 0.0, RADIUS, 0.0, 0.0, 0.0, 1.0], (4, 1)).astype(dtype)
    q[:, 2] += gravity[:, 2] / scene.values["contact_stiffness"][0, 0]
    qd = np.broadcast_to(qd, (4, 6)).astype(dtype)
    report, status, rates = dyn.step_report(*REPORTS, like=q), np.zeros(4, np.int32), [qd]
    for _ in range(round(seconds / h)):
        q, qd = dyn.step(q, rates[-1], dt=h, status=status, report=report)
        rates.append(qd)
        assert not status.any()
    return np.array(rates, dtype=np.float64), report


def with_pair(**friction):
    """A body that touches another one."""
    bodies = [spo.Body(1.0, inertia=TURN * np.eye(3)) for _ in range(2)]
    contacts = [spo.Contact(0, sphere=RADIUS, other=spo.Contact(1, sphere=RADIUS), **friction)]
    return spo.Scene(bodies, [spo.Hinge("free", -1, i) for i in range(2)], contacts=contacts)


# -- closed forms ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("h", [1e-3, 1e-2])
def test_what_spins_on_a_point_slows_down_by_the_moment_and_stays(h, dtype, device):
    """Torsional friction takes mu m g / I off the rate; rolling friction alone takes nothing."""
    spin, roll = np.array([0.0, SPIN, 2.0 * SPIN, 0.0]), [0.0, 0.0, ROLL, ROLL]
    rates, report = run(spin, roll, [0, 0, 0, 0, 0, 5.0], 0.7, h, dtype=dtype, device=device)
    half, close = round(0.15 / h), EXACT[dtype]
    slowing = (5.0 - rates[half, :, 5]) / (half * h)
    np.testing.assert_allclose(slowing, spin * G / TURN, rtol=SLOWING, atol=1e-3)
    np.testing.assert_allclose(rates[-1, [0, 3], 5], 5.0, rtol=close)
    assert np.abs(rates[-1, 1:3]).max() <= STOPPED[dtype]  # they stop after 0.41 and 0.2 s
    assert np.abs(report.contact_moment[:, 0]).max() <= STOPPED[dtype]


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("h", [1e-3, 1e-2])
def test_what_rolls_slows_down_and_stops(h, dtype, device):
    """By 5/7 mu g / r while it does not slide; torsional and sliding friction alone take nothing."""
    roll, start = np.array([0.0, 4.0 * ROLL, 8.0 * ROLL, 0.0]), [0.3, 0.0, 0.0, 0.0, 0.3 / RADIUS, 0.0]
    rates, _ = run([0.0, 0.0, SPIN, SPIN], roll, start, 0.8, h, dtype=dtype, device=device)
    first, last = round(0.02 / h), round(0.2 / h)
    slowing = (rates[first, :, 0] - rates[last, :, 0]) / ((last - first) * h)
    np.testing.assert_allclose(slowing, 5.0 / 7.0 * roll * G / RADIUS, rtol=SLOWING, atol=1e-3)
    assert np.abs(rates[-1, 1:3]).max() <= STOPPED[dtype]  # they stop after 0.54 and 0.27 s
    assert np.abs(rates[:, [0, 3], 0] - 0.3).max() <= 1e-3 * 0.3


def test_what_stands_on_a_slope_holds_below_the_ratio_of_friction_and_radius(device):
    """It creeps there by eps rho / sqrt(1 - rho^2) over the length of turning, and rolls as it should beyond."""
    ratio, rho = ROLL / RADIUS, np.array([0.5, 0.9, 1.5, 3.0])
    rates, report = run(0.0, ROLL, np.zeros(6), 1.0, slope=rho * ratio, device=device)
    length = np.sqrt(TURN)  # of a free body of 1 kg: the radius of gyration
    holds = rho[:2]
    slow = sphere().contacts[0].eps / length
    np.testing.assert_allclose(rates[-1, :2, 4], slow * holds / np.sqrt(1.0 - holds**2), rtol=2e-2)
    rolls = rho[2:] * ratio
    gained = (rates[-1, 2:, 0] - rates[100, 2:, 0]) / 0.5
    np.testing.assert_allclose(gained, 5.0 / 7.0 * G * np.cos(np.arctan(rolls)) * (rolls - ratio), rtol=1e-3)
    assert not report.contact_excess.any()


def test_three_passes_never_gain():
    """Energy of a quadruped at held poses, with coefficients up to its soles' size."""
    rng = np.random.default_rng(1)
    for _ in range(150):
        M, laws, limits, points, v, h = quadruped_case(rng)
        turning = points.turning.copy()
        turning[:, :2] = 10.0 ** rng.uniform(-4.0, -1.5, (len(turning), 2))
        found = rise(reference.solve, (M, laws, limits, points._replace(turning=turning), v, h), 3)
        assert found <= ROUNDING


# -- against the dense step --------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("name", "passes"), [("cube", 1), ("cube", 4), ("quadruped", 3)])
def test_the_recursion_is_the_dense_step(name, passes):
    scene = with_turning(box(friction=0.3) if name == "cube" else quadruped())
    q, qd, tau = touching(scene, 1, 4)
    assert_is_dense(scene, {"q": q, "qd": qd, "tau": tau}, passes)


@pytest.mark.parametrize("name", FIELDS)
def test_a_height_field_has_the_same_law(name):
    scene = with_turning(box(ground=FIELDS[name]))
    assert_is_dense(scene, above(scene, 3, 6), 3)


def test_one_coefficient_has_the_law_without_the_other():
    """Of points that have one, both or neither, on a link with few points."""
    shapes = [dict(sphere=((0.1, 0, -0.05), 0.05)), dict(point=(0, 0.1, -0.1))]
    scene = box().with_contacts([spo.Contact(0, **shape) for shape in shapes])
    for torsional, rolling in (([0.02, 0.0], [0.0, 0.01]), ([0.0, 0.02], [0.0, 0.0])):
        turning = scene.with_values(contact_torsional_friction=torsional, contact_rolling_friction=rolling)
        q, qd, tau = touching(turning, 1, 4)
        assert_is_dense(turning, {"q": q, "qd": qd, "tau": tau}, 3)


@pytest.mark.parametrize("passes", [3, 4])
def test_gradients_are_differences(passes):
    """Of a ball that rolls and slides, and spins, over rough ground, by its state and the coefficients."""
    field = FIELDS["rough"]
    contacts = [spo.Contact(0, sphere=(at, 0.1), friction=0.3) for at in ((0, 0, 0), (0.1, 0, 0))]
    scene = with_turning(box().with_contacts([*contacts, spo.Contact(0, point=(0, 0, 0.1))], field))
    a = contact_gradients.furnish(scene, above(scene, 1, 6))
    names = ("q", "qd", "contact_friction", "contact_torsional_friction", "contact_rolling_friction")
    errors = contact_gradients.errors(scene, a, H, passes, names=names)
    assert max(error for error, _ in errors.values()) <= 1e-5, errors  # 1e-7 measured
    assert max(crossed for _, crossed in errors.values()) <= 1 / 6, errors  # one draw: the nearest cell changes


def test_substeps_and_reports(device):
    """Moments on the sphere about the vertical; as many substeps in one launch have the bits of steps."""
    dyn, q = compiled("float64", str(device)), np.tile([0.0, 0.0, 0.0999, 0.0, 0.0, 0.0, 1.0], (4, 1))
    spin, qd = np.array([[0.0], [SPIN], [2.0 * SPIN], [SPIN]]), np.tile([0.1, 0.0, -0.1, 0.3, 1.0, 3.0], (4, 1))
    dyn.set(contact_torsional_friction=spin, contact_rolling_friction=spin, gravity=np.array([0.0, 0.0, -G]))
    report, status = dyn.step_report(*REPORTS, like=q), np.zeros(4, np.int32)
    settled = spo.StepOptions(passes=6)  # three passes miss by 2e-2 in this step, in which the push changes
    q, qd = dyn.step(q, qd, dt=H, options=settled, status=status, report=report)
    push = report.contact_f[:, :, 2]
    np.testing.assert_allclose(report.contact_moment[:, :, 2], -spin * push, rtol=1e-4)
    across = report.contact_moment[:, :, :2]
    np.testing.assert_allclose(np.linalg.norm(across, axis=2), spin * push, rtol=1e-4)
    assert (np.einsum("wpi,wi->w", across, qd[:, 3:5])[1:] < 0.0).all()
    asked = dict(status=status, report=report)
    fused = dyn.step(q, qd, dt=H, options=spo.StepOptions(substeps=5), **asked)
    for _ in range(5):
        q, qd = dyn.step(q, qd, dt=H, **asked)
    assert not status.any() and (fused[0] == q).all() and (fused[1] == qd).all()
    scene = sphere(rolling_friction=ROLL).with_values(contact_torsional_friction=[[SPIN], [0.0]])
    assert "torsional friction 0 to 0.005 m, rolling friction 0.002 m" in spo.Dynamics(scene, 2).explain()


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_limbs_of_other_coefficients(dtype, device):
    """Segments that share code, beside the dense step; and torch's gradient by the coefficients."""
    scene = with_turning(quadruped())
    a = [x.astype(dtype) for x in touching(scene, 1, 6)]
    for granularity in ("tree", "segment"):
        dyn = spo.Dynamics(scene, 6, device, dtype, granularity=granularity)
        report = dyn.step_report("contact_moment", like=a[0])
        _, found = dyn.step(*a, dt=H, report=report)
        for world in range(6):
            at = ContactStep(scene, a[0][world], a[1][world], H)
            wanted = at.run(a[2][world])[1]
            moment = by_point(at, wanted.moment)[0]
            close = 1e-10 if dtype == "float64" else 1e-5
            np.testing.assert_allclose(found[world], wanted.v, atol=close * abs(wanted.v).max())
            # a moment that sticks is a secant of 1 / eps = 1e4 s/m: it loses a digit more than the rates
            moments = close * (40 * abs(moment).max() + 1)
            np.testing.assert_allclose(report.contact_moment[world], moment, atol=moments)
    if dtype == "float32":
        return
    names = ("contact_torsional_friction", "contact_rolling_friction")
    dyn = spo.Dynamics(scene, 6, device, dtype, granularity="segment", variable=names)
    given = [torch.tensor(x, device=wp.device_to_torch(device)) for x in a]
    values = {
        name: torch.tensor(np.tile(scene.values[name], (6, 1)), device=wp.device_to_torch(device)) for name in names
    }

    def loss(values):
        dyn.set(**values)
        q, qd = dyn.step(*given, dt=H)
        return (q.sum(1) + 0.3 * qd.sum(1)).sum()

    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    found = torch.autograd.grad(loss(leaves), list(leaves.values()))
    for name, gradient in zip(names, found, strict=True):
        for world, point in ((0, 0), (1, 2), (2, 7)):
            by = torch.zeros_like(values[name])
            by[world, point] = 1e-7
            ends = [loss(values | {name: values[name] + sign * by}) for sign in (1.0, -1.0)]
            assert abs((ends[0] - ends[1]) / 2e-7 - gradient[world, point]) <= 1e-5 * abs(gradient).max()


# -- MuJoCo and files --------------------------------------------------------------------------------------------------
BALL = """<mujoco><option timestep="0.001" cone="elliptic" impratio="100" gravity="{gx} 0 {gz}"/><worldbody>
<geom name="floor" type="plane" size="9 9 1" condim="1"/><body pos="0 0 0.0999"><freejoint/>
<geom type="sphere" size="0.1" mass="1" condim="{condim}" friction="0.8 {spin} {roll}"/></body></worldbody></mujoco>"""


def mujocos_rates(qvel, slope=0.0, condim=6, spin=0.0, roll=0.0, steps=300):
    """MuJoCo's rates of the sphere after each step; the slope tilts gravity."""
    tilt = np.arctan(slope)
    xml = BALL.format(gx=G * np.sin(tilt), gz=-G * np.cos(tilt), condim=condim, spin=spin, roll=roll)
    model = mujoco.MjModel.from_xml_string(xml)
    data, rates = mujoco.MjData(model), []
    data.qvel[:] = qvel
    for _ in range(steps):
        mujoco.mj_step(model, data)
        rates.append(data.qvel.copy())
    return np.array(rates)


def test_mujoco_spins_and_rolls_alike(device):
    """Elliptic cones: how fast a sphere slows down, and how fast it gets beyond the slope that it stands on."""
    gain = lambda rates, dof, h: (rates[round(0.25 / h), dof] - rates[round(0.15 / h), dof]) / 0.1  # noqa: E731
    spins, rolls = [0, 0, 0, 0, 0, 5.0], [0.3, 0, 0, 0, 3.0, 0]
    theirs = [
        gain(mujocos_rates(spins, condim=4, spin=SPIN), 5, 1e-3),
        gain(mujocos_rates(rolls, roll=ROLL), 4, 1e-3),
        gain(mujocos_rates(np.zeros(6), slope=0.06, roll=ROLL), 4, 1e-3),
    ]
    start = [spins, rolls, np.zeros(6), np.zeros(6)]
    rates, _ = run([SPIN, 0.0, 0.0, 0.0], [0.0, ROLL, ROLL, 0.0], start, 0.3, slope=[0, 0, 0.06, 0], device=device)
    ours = [gain(rates[:, world], dof, H) for world, dof in enumerate((5, 4, 4))]
    np.testing.assert_allclose(ours, theirs, rtol=0.01)


RUBBED = """<mujoco><default><geom type="sphere" size="0.1" friction="0.6 0.02 0.004"/></default><worldbody>
 <geom name="floor" type="plane" size="1 1 1" {floor}/><body><freejoint/><geom name="plain"/>
 <geom name="spins" condim="4"/><geom name="rolls" condim="6" friction="0.9 0.01 0.03"/><geom name="one" condim="1"/>
 <geom name="first" condim="6" friction="0.3 0.01 0.002" priority="2"/>
 <geom name="listed" contype="0" conaffinity="0"/><geom name="tight" contype="0" conaffinity="0"/></body></worldbody>
 <contact><pair geom1="floor" geom2="listed" condim="6" friction="0.4 0.4 0.03 0.01 0.01"/>
 <pair geom1="tight" geom2="floor" condim="4" friction="0.2 0.2 0.07 0.3 0.3"/></contact></mujoco>"""
FLOORS = ["", 'condim="4" friction="0.1 0.05 0.05"', 'condim="6" priority="1"', 'priority="3"']


@pytest.mark.parametrize("floor", FLOORS)
def test_friction_of_files_is_mujocos(floor, tmp_path):
    """The larger of both, or that of higher priority, as far as the contact's dimensions go; a pair has its own."""
    file = tmp_path / "rubbed.xml"
    file.write_text(RUBBED.format(floor=floor))
    model = mujoco.MjModel.from_xml_path(str(file))
    data, wanted = mujoco.MjData(model), {}
    mujoco.mj_forward(model, data)
    for contact in data.contact:
        slide, _, spin, roll, _ = contact.friction
        values = [value if contact.dim >= least else 0.0 for value, least in ((slide, 3), (spin, 4), (roll, 6))]
        wanted[model.geom(contact.geom[1]).name or model.geom(contact.geom[0]).name] = values
    scene = spo.load(file, contacts="ground")
    found = {one.label: [one.friction, one.torsional_friction, one.rolling_friction] for one in scene.contacts}
    assert len(found) == 7 and found.keys() == wanted.keys()
    for name, values in wanted.items():
        np.testing.assert_allclose(found[name], values, atol=1e-12, err_msg=name)


def test_a_pair_that_rolls_differently_along_and_across_is_said_to_be_left_out(tmp_path):
    file = tmp_path / "pair.xml"
    file.write_text(RUBBED.format(floor="").replace("0.03 0.01 0.01", "0.03 0.01 0.02"))
    with pytest.warns(UserWarning, match="the rolling friction 0.02 across of a contact pair of geom 'listed'"):
        scene = spo.load(file, contacts="ground")
    assert {one.label: one.rolling_friction for one in scene.contacts}["listed"] == 0.01


def test_friction_of_urdf_is_bullets(tmp_path):
    file = tmp_path / "ball.urdf"
    given = "".join(
        f'<{tag} value="{value}"/>' for tag, value in (("spinning_friction", SPIN), ("rolling_friction", ROLL))
    )
    shape = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
    mass = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    file.write_text(f'<robot name="r"><link name="a">{mass}{shape}<contact>{given}</contact></link></robot>')
    (contact,) = spo.load(file, floating=True, contacts="ground").contacts
    assert (contact.friction, contact.torsional_friction, contact.rolling_friction) == (0.8, SPIN, ROLL)


# -- refusals ----------------------------------------------------------------------------------------------------------
def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"torsional_friction is -1\.0; expected a positive number"):
        sphere(torsional_friction=-1.0)
    with pytest.raises(spo.UnsupportedError, match="rolling_friction= of a contact between bodies"):
        with_pair(rolling_friction=ROLL)
    with pytest.raises(ValueError, match="contact_rolling_friction has shape"):
        with_pair().with_values(contact_rolling_friction=[ROLL])
    dyn, q = spo.Dynamics(sphere(), 1), np.array([[0, 0, RADIUS, 0, 0, 0, 1]], np.float32)
    asked = spo.StepReport(contact_moment=np.zeros((1, 1, 3), np.float32))
    with pytest.raises(ValueError, match="no contact has torsional or rolling friction"):
        dyn.step(q, np.zeros((1, 6), np.float32), None, H, report=asked)
