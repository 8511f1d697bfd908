"""The dense step with contacts: passive at a held pose, at rest on flat and tilted ground; and bugs planted in it."""

import numpy as np
import pytest

import warp_spo as spo
from support import symbolic
from support.contact_cases import STAND, box, pressed, quadruped, quadruped_case, random_case, rise
from warp_spo.reference import contact as reference
from warp_spo.reference.contact import ContactStep

ROUNDING = 1e-11  # of the energy before; dense solves of masses that differ by 1e4
H = 5e-3


def tilted(degrees):
    """A plane that falls along x."""
    angle = np.radians(degrees)
    return spo.Plane(normal=(np.sin(angle), 0.0, np.cos(angle)))


def slide(degrees, steps, **contact):
    """Return the velocities of a cube on a tilted plane, down the plane, after each step, and what the last found."""
    scene = box(ground=tilted(degrees), **contact)
    half = 0.5 * np.radians(degrees)
    up, down = np.array(scene.ground.normal), np.array([np.cos(2 * half), 0.0, -np.sin(2 * half)])
    q = np.concatenate([up * 0.0999, [0.0, np.sin(half), 0.0, np.cos(half)]])
    qd, found, speeds = np.zeros(6), None, []
    for _ in range(steps):
        q, found = ContactStep(scene, q, qd, H).run()
        qd = found.v
        speeds.append(down @ qd[:3])
    return np.array(speeds), found


def one_pass_never_gains(cases):
    """With every candidate closed, no friction, drive or limit can raise the energy of a held pose."""
    rng = np.random.default_rng(0)
    worst = max(rise(reference.solve, pressed(random_case(rng)), 1) for _ in range(cases))
    assert worst <= ROUNDING, f"one pass raised the energy by {worst:.1e} of it"


def three_passes_never_gain(cases):
    rng = np.random.default_rng(1)
    found = np.array([rise(reference.solve, quadruped_case(rng), 3) for _ in range(cases)])
    assert not (found > ROUNDING).any(), f"{(found > ROUNDING).sum()} of {cases} rise, by {found.max():.1e} at most"


def test_one_pass_never_gains():
    one_pass_never_gains(1000)


def test_three_passes_never_gain():
    three_passes_never_gain(300)


@pytest.mark.slow
def test_ten_thousand_cases_of_one_pass_and_1500_of_three():
    one_pass_never_gains(10000)
    three_passes_never_gain(1500)


def test_a_cube_stands():
    """Sum of forces m g, sunk by m g / 4 k, at rest."""
    scene = box()
    q, qd = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]), np.zeros(6)
    for _ in range(80):
        q, found = ContactStep(scene, q, qd, H).run()
        qd = found.v
    weight = 5.0 * 9.81
    np.testing.assert_allclose(found.f.sum(axis=0), [0.0, 0.0, weight], atol=1e-4 * weight)
    assert abs(0.1 - q[2] - weight / 4.0 / scene.values["contact_stiffness"][0, 0]) <= 1e-6
    assert np.abs(qd).max() <= 1e-5 and not found.excess.any()


@pytest.mark.parametrize(("given", "speeds"), [({}, (0.9, 1.001)), ({"damping": 0.0}, (5.0, 90.0))])
def test_what_starts_deep_comes_out_slowly(given, speeds):
    """From 0.3 m below ground, turned, at PUSH_OUT at most; as fast as the spring throws it where damping is given."""
    scene, turn = box(**given), np.array([0.3, 0.2, 0.1, 1.0])
    q, qd, fastest = np.array([0.0, 0.0, -0.3, *(turn / np.linalg.norm(turn))]), np.zeros(6), 0.0
    for _ in range(20):
        step = ContactStep(scene, q, qd, H)
        q, found = step.run()
        out = np.einsum("pa,pa->p", step.points.n, step.points.J @ found.v)[step.points.depth > 0.05]
        qd, fastest = found.v, max(fastest, out.max(initial=0.0))
    assert speeds[0] <= fastest <= speeds[1]


def test_a_cube_creeps_where_it_sticks_and_slides_as_coulomb_says():
    """Creep eps rho / sqrt(1 - rho^2) for the share rho of friction that is used; acceleration g (sin - mu cos)."""
    speeds, found = slide(20.0, 60)
    rho = np.tan(np.radians(20.0)) / 0.8
    np.testing.assert_allclose(speeds[-1], 1e-4 * rho / np.sqrt(1.0 - rho**2), rtol=2e-2)  # still settling
    assert not found.excess.any()
    speeds, _ = slide(30.0, 120, friction=0.5)  # what three passes leave falls with the square of the speed
    wanted = 9.81 * (np.sin(np.radians(30.0)) - 0.5 * np.cos(np.radians(30.0)))
    assert abs(np.diff(speeds[100:]).mean() / H / wanted - 1.0) <= 1e-3


def test_nothing_acts_above_the_ground():
    """A point that the step does not carry to the ground feels nothing, however fast it comes."""
    scene = box()
    q = np.array([0.0, 0.0, 0.12, 0.0, 0.0, 0.0, 1.0])
    _, found = ContactStep(scene, q, np.array([1.0, 0.0, -3.0, 0.0, 0.0, 0.0]), H).run()
    assert not found.f.any()
    np.testing.assert_allclose(found.v, [1.0, 0.0, -3.0 - 9.81 * H, 0.0, 0.0, 0.0], atol=1e-12)


def test_a_point_that_another_contact_throws_down_is_caught():
    """A lever whose one end lands: its other end starts above the ground and at rest."""
    hinges = [spo.Hinge("free", -1, 0)]
    contacts = [spo.Contact(0, point=(x, 0.0, 0.0), stiffness=1e6, damping=10.0) for x in (-0.5, 0.1)]
    scene = spo.Scene([spo.Body(1.0, inertia=np.eye(3) * 5e-3)], hinges, contacts=contacts)
    turn = 0.5 * np.arcsin(7e-4 / 0.6)  # the second end is 0.7 mm above the ground, where the first one touches
    q = np.array([0.0, 0.0, 0.5 * 7e-4 / 0.6, 0.0, -np.sin(turn), 0.0, np.cos(turn)])
    qd = np.array([0.0, 0.0, -1.0, 0.0, -10.0, 0.0])  # (-0.5, 0, 0) falls at 6 m/s, (0.1, 0, 0) is at rest
    at = ContactStep(scene, q, qd, H)
    np.testing.assert_allclose(at.points.J[:, 2] @ qd, [-6.0, 0.0], atol=1e-2)
    _, found = at.run()
    sunk = at.points.depth - H * (at.points.J[:, 2] @ found.v)
    assert sunk[1] <= 4e-4, f"the other end sank {1e3 * sunk[1]:.1f} mm"


def test_a_depth_after_the_step_follows_the_path():
    """Of a quadruped whose rates stay as they are: what is left is of third order in h."""
    scene, rng = quadruped(), np.random.default_rng(3)
    q = np.concatenate([[0.0, 0.0, 0.3], [0.1, 0.2, 0.0, 0.97], STAND])
    q[3:7] /= np.linalg.norm(q[3:7])
    qd, missed = 5.0 * rng.normal(size=18), []
    for h in (4e-3, 2e-3):
        at = ContactStep(scene, q, qd, h)
        after = ContactStep(scene, at.dense.integrate(qd, h), qd, h).points.depth
        missed.append(np.abs(after - at.points.after(at.points.J @ qd, h)).max())
    assert missed[0] / missed[1] >= 7.0 and missed[0] <= 1e-4


def test_the_last_pass_only_closes():
    rng = np.random.default_rng(2)
    for _ in range(200):
        M, laws, limits, points, v, h = random_case(rng)
        two, three = (reference.solve(M, laws, limits, points, v, 0.0 * v, h, passes).on for passes in (2, 3))
        assert (three | ~two).all()


BUGS = {
    "first pass opens": ("solve", "candidate & (first | (points.push(at, h) > 0.0))",
                         "candidate & (points.push(at, h) > 0.0)",
                         test_one_pass_never_gains),
    "last pass opens": ("solve", "closed, by_rule = closed | on, limit_on & ~held", "pass",
                        test_the_last_pass_only_closes),
    "candidates frozen": ("solve", "candidate = candidate | (points.after(at, h) > 0.0)", "pass",
                          test_a_point_that_another_contact_throws_down_is_caught),
    "dampers above ground": ("solve", "closed = candidate &", "closed =", test_nothing_acts_above_the_ground),
    "tangent friction": ("dampers", "across[:, None, None] * (np.eye(3) - nn)",
                         "(across * points.eps**2 / (w**2 + points.eps**2))[:, None, None] * (np.eye(3) - nn)",
                         test_a_cube_creeps_where_it_sticks_and_slides_as_coulomb_says),
    "active set": ("solve", "S + drive_s, l + drive_s * laws.a",
                   "S + drive_s * (drive_s == laws.s), "
                   "l + np.where(drive_s == laws.s, drive_s * laws.a, np.sign(laws.a - v) * laws.effort)",
                   test_three_passes_never_gain),
}  # fmt: skip


@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_seen(monkeypatch, bug):
    function, old, new, test = BUGS[bug]
    symbolic.plant(monkeypatch, reference, function, old, new)
    with pytest.raises(AssertionError):
        test()
