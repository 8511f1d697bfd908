"""Modal data of beams, beside closed forms, other quadrature and finite differences."""

import copy
import pickle

import numpy as np
import pytest

import warp_spo as spo

LENGTH = 1.3
SECTION = spo.Section.rectangle(0.02, 0.05)
MATERIAL = spo.Material(2700.0, 7e10)
LINE, EI_Y, EI_Z = 2700.0 * SECTION.area, 7e10 * SECTION.Iz, 7e10 * SECTION.Iy  # bending along y, along z
POLAR, GJ, EA = 2700.0 * (SECTION.Iy + SECTION.Iz), MATERIAL.G * SECTION.torsion, 7e10 * SECTION.area
ALL = {"y": 3, "z": 2, "torsion": 2, "axial": 2}
QUADRATURE = 2e-10  # beam_modes promises 1e-10 of the largest entry
FREE = [4.730040744862704, 7.853204624095838, 10.995607838001671]  # of cos z cosh z = 1


def modes_of(ends="clamped", count=None, **values):
    element = {"y": 2, "z": 2, "torsion": 1, "axial": 1}
    count = (element if ends == "element" else ALL) if count is None else count
    return spo.beam_modes(LENGTH, SECTION, MATERIAL, ends, count, **{"rotary": False, **values})


def whole_mass(modes):
    """Mass matrix of the free body for (omega; v; amplitudes), from the arrays."""
    mass, com, inertia = modes.rigid
    c = np.cross(np.eye(3), com)  # the matrix of com x
    rigid = np.block([[inertia + mass * c @ c.T, mass * c], [mass * c.T, mass * np.eye(3)]])
    return np.block([[rigid, modes.coupling], [modes.coupling.T, modes.mass]])


def clamped_roots(count):
    """The first positive roots of cos z + 1 / cosh z, by bisection."""
    low, high = np.arange(count) * np.pi, np.arange(1, count + 1) * np.pi
    up = np.where(np.arange(count) % 2, 1.0, -1.0)
    for _ in range(60):
        z = 0.5 * (low + high)
        above = up * (np.cos(z) + 1.0 / np.cosh(z)) > 0.0
        low, high = np.where(above, low, z), np.where(above, z, high)
    return z


def frequencies(mass, stiffness):
    return np.sqrt(np.sort(np.abs(np.linalg.eigvals(np.linalg.solve(mass, np.diag(stiffness))))))


@pytest.mark.parametrize("count", [1, 4, 20])
def test_clamped_frequencies_are_the_closed_forms(count):
    modes = modes_of(count={"y": count})
    expected = clamped_roots(count) ** 2 * np.sqrt(EI_Y / LINE) / LENGTH**2
    np.testing.assert_allclose(frequencies(modes.mass, modes.stiffness), expected, rtol=1e-9)
    np.testing.assert_allclose(modes.mass, 0.25 * LINE * LENGTH * np.eye(count), atol=QUADRATURE * LINE * LENGTH)


def test_clamped_twist_and_stretch():
    modes = modes_of(count={"torsion": 3, "axial": 3})
    odd = np.array([1, 3, 5]) * 0.5 * np.pi / LENGTH
    np.testing.assert_allclose(np.sqrt(modes.stiffness[:3] / np.diag(modes.mass)[:3]), odd * np.sqrt(GJ / POLAR))
    np.testing.assert_allclose(np.sqrt(modes.stiffness[3:] / np.diag(modes.mass)[3:]), odd * np.sqrt(EA / LINE))


def test_a_free_beam_vibrates_as_the_closed_forms_say():
    """With the six rates of the body frame, shapes relative to one end span those of the free beam."""
    modes = modes_of("free", ALL)
    found = frequencies(whole_mass(modes), [*np.zeros(6), *modes.stiffness])
    expected = [
        *(np.array(FREE[:3]) ** 2 / LENGTH**2 * np.sqrt(EI_Y / LINE)),
        *(np.array(FREE[:2]) ** 2 / LENGTH**2 * np.sqrt(EI_Z / LINE)),
        *(np.array([1, 2]) * np.pi / LENGTH * np.sqrt(GJ / POLAR)),
        *(np.array([1, 2]) * np.pi / LENGTH * np.sqrt(EA / LINE)),
    ]
    np.testing.assert_allclose(found[6:], np.sort(expected), rtol=1e-8)
    assert found[5] < 1e-3 * found[6]


def test_an_element_has_the_compliance_of_a_beam_loaded_at_its_tip():
    modes = modes_of("element", children={"tip": LENGTH})
    slopes = modes.slopes["tip"]
    bend = np.array([[LENGTH**3 / 3, LENGTH**2 / 2], [LENGTH**2 / 2, LENGTH]])
    expected = np.zeros((6, 6))
    expected[0, 0], expected[3, 3] = LENGTH / GJ, LENGTH / EA
    expected[np.ix_([4, 2], [4, 2])] = bend / EI_Y
    expected[np.ix_([5, 1], [5, 1])] = bend / EI_Z * [[1, -1], [-1, 1]]
    np.testing.assert_allclose(slopes / modes.stiffness @ slopes.T, expected, atol=1e-12 * expected.max())


@pytest.mark.parametrize("rotary", [False, True])
@pytest.mark.parametrize("ends", ["clamped", "free", "element"])
def test_arrays_are_integrals_over_the_beam(ends, rotary):
    """Simpson's sums over slopes and displacements of sections, with the inertia of twisting sections."""
    modes, expected, N = modes_of(ends, rotary=rotary), 0.0, 200
    turning = 2700.0 * np.array([SECTION.Iy + SECTION.Iz, SECTION.Iy, SECTION.Iz]) * (1, rotary, rotary)
    weights = np.array([1.0, *([4.0, 2.0] * (N // 2))[:-1], 1.0]) * LENGTH / (3 * N)
    for at, weight in zip(np.linspace(0.0, LENGTH, N + 1), weights, strict=True):
        slopes, _ = modes.shape((at, 0.0, 0.0))
        turn = np.hstack([np.eye(3), np.zeros((3, 3)), slopes[:3]])
        move = np.hstack([[[0, 0, 0], [0, 0, at], [0, -at, 0]], np.eye(3), slopes[3:]])
        move[1, 2], move[2, 1], move[1, 1], move[2, 2] = at, -at, 0.0, 0.0
        expected = expected + weight * (LINE * move.T @ move + turn.T * turning @ turn)
    scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    np.testing.assert_allclose(whole_mass(modes) / scale, expected / scale, atol=1e-6)  # of Simpson's rule
    assert np.linalg.eigvalsh(whole_mass(modes) / scale)[0] > 0.0


def test_the_points_are_few():
    """An element's polynomials of degree 3 need four points; fewer points than needed miss the sums."""
    assert len(modes_of("element").points.mass) == 4
    assert len(modes_of("element", {"y": 1}).points.mass) == 3
    modes = modes_of(count={"y": 3})
    fewer = modes_of(count={"y": 3}, points=len(modes.points.mass) - 1)
    assert np.abs(modes.mass / (0.25 * LINE * LENGTH) - np.eye(3)).max() < QUADRATURE
    assert np.abs(fewer.mass / (0.25 * LINE * LENGTH) - np.eye(3)).max() > 0.5e-10
    np.testing.assert_allclose(modes.points.mass.sum(), modes.rigid[0], rtol=1e-14)


def test_centrifugal_stiffness_is_the_known_integral():
    """Of cantilever modes of unit modal mass (Wright et al., 1982): the mass times foreshortening times distance."""
    modes = spo.beam_modes(1.0, spo.Section(1.0, 1e-12, 1e-12), spo.Material(1.0, 1e12), count={"y": 3})
    points = modes.points
    found = np.einsum("s,s,sij->ij", points.mass, points.position[:, 0], points.stiffening[:, 0])
    np.testing.assert_allclose(4.0 * np.diag(found), [1.19334, 6.47822, 17.85952], atol=5e-6)


@pytest.mark.parametrize("ends", ["clamped", "free", "element"])
def test_foreshortening_keeps_the_length(ends):
    """The curve x - eta* G eta / 2, displaced along y and z, has unit speed up to fourth order in the amplitudes."""
    modes, h = modes_of(ends), 1e-5
    eta = np.random.default_rng(1).normal(size=modes.count) * 1e-2
    axial = [i for i in range(modes.count) if np.abs(modes.coupling[3, i]) > 1e-9]
    eta[axial] = 0.0

    def place(x):
        slopes, second = modes.shape((x, 0.0, 0.0))
        return slopes[3:] @ eta - 0.5 * np.einsum("cij,i,j->c", second, eta, eta) + (x, 0.0, 0.0)

    for x in (0.2, 0.7, 1.2):
        speed = (place(x + h) - place(x - h)) / (2 * h)
        slope = np.abs(speed[1:]).max()
        assert abs(speed @ speed - 1.0) < slope**4 + 1e-9 and slope > 1e-3


def test_what_is_attached_beside_the_axis_turns_with_the_section():
    """To second order: a frame at an arm (y, z) moves as exp(slopes eta) turns the arm."""
    modes, arm = modes_of("clamped"), np.array([0.0, 0.03, -0.05])
    eta = np.random.default_rng(2).normal(size=modes.count) * 1e-4
    on, on_second = modes.shape((0.9, 0.0, 0.0))
    off, off_second = modes.shape((0.9, *arm[1:]))
    np.testing.assert_array_equal(on[:3], off[:3])
    turn = np.array([np.cross(on[:3] @ eta, e) for e in np.eye(3)]).T
    expected = (turn + 0.5 * turn @ turn) @ arm  # less than third order
    found = (off - on)[3:] @ eta - 0.5 * np.einsum("cij,i,j->c", off_second - on_second, eta, eta)
    assert np.abs(turn @ turn @ arm).max() > 1e-10
    np.testing.assert_allclose(found, expected, atol=1e-17)


def test_a_frame_beyond_the_tip_moves_with_the_tip():
    modes = modes_of()
    tip, _ = modes.shape((LENGTH, 0.0, 0.0))
    beyond, second = modes.shape((LENGTH + 0.2, 0.0, 0.0))
    arm = np.array([0.2, 0.0, 0.0])
    np.testing.assert_allclose(beyond[3:] - tip[3:], np.cross(tip[:3], arm[:, None], axis=0), atol=1e-14)
    turns = tip[1:3]
    expected = modes.shape((LENGTH, 0.0, 0.0))[1][0] + 0.2 * turns.T @ turns  # the arm's cosine
    np.testing.assert_allclose(second[0], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("stiffening", [True, False])
def test_children_get_the_slopes_of_their_place(stiffening):
    modes = modes_of(children={"tip": LENGTH, 2: (0.4, 0.1, 0.0)}, stiffening=stiffening)
    for child, place in (("tip", (LENGTH, 0, 0)), (2, (0.4, 0.1, 0.0))):
        slopes, second = modes.shape(place)
        np.testing.assert_array_equal(modes.slopes[child], slopes)
        if stiffening:
            np.testing.assert_allclose(modes.stiffening[child], second, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(modes.slopes["tip"][4, :3], 1.0, rtol=1e-12)  # amplitudes: displacements of the tip
    np.testing.assert_allclose(modes.slopes["tip"][0, 5:7], 1.0, rtol=1e-12)
    if not stiffening:
        assert second is None and not modes.stiffening and modes.points.stiffening is None


def test_damping_is_a_share_of_the_critical_one():
    modes = modes_of(damping_ratio=0.02)
    mass = np.diag(modes.mass)
    np.testing.assert_allclose(modes.damping, 0.04 * np.sqrt(modes.stiffness / mass) * mass)
    assert not modes_of().damping.any()


def test_an_integer_counts_bending_in_both_planes():
    np.testing.assert_array_equal(modes_of(count=2).mass, modes_of(count={"y": 2, "z": 2}).mass)
    assert spo.beam_modes(LENGTH, SECTION, MATERIAL).count == 4


def test_copies_and_pickles_keep_the_shapes():
    modes = modes_of("free")
    for other in (pickle.loads(pickle.dumps(modes)), copy.deepcopy(modes)):
        np.testing.assert_array_equal(other.shape((0.5, 0.0, 0.1))[0], modes.shape((0.5, 0.0, 0.1))[0])
        np.testing.assert_array_equal(other.points.shapes, modes.points.shapes)


def test_sections_and_materials():
    """Torsion of a square: 0.1406 a^4; of a thin strip: (1 - 0.63 b / a) a b^3 / 3 (Timoshenko and Goodier)."""
    square, strip = spo.Section.rectangle(2.0, 2.0), spo.Section.rectangle(0.1, 5.0)
    np.testing.assert_allclose(square.torsion, 0.140577 * 16, rtol=1e-5)
    np.testing.assert_allclose(strip.torsion, 5.0 * 0.1**3 / 3 * (1 - 0.630249 * 0.02), rtol=1e-6)
    assert strip.Iz < strip.Iy  # the short side is y: it bends along y
    disc, tube, hole = spo.Section.circle(0.5), spo.Section.tube(0.5, 0.1), spo.Section.circle(0.4)
    for name in ("area", "Iy", "Iz", "torsion"):
        np.testing.assert_allclose(getattr(tube, name), getattr(disc, name) - getattr(hole, name))
    np.testing.assert_allclose(disc.torsion, np.pi * 0.5**4 / 2)
    assert spo.Material(1.0, 2.6).G == pytest.approx(1.0) and spo.Material(1.0, 2.4, G=1.0).nu == pytest.approx(0.2)
    assert spo.Material(1.0, 2.0, nu=0.0).G == 1.0


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: spo.Section(0.0, 1.0, 1.0), "area is 0.0; expected"),
        (lambda: spo.Section(1.0, -1.0, 1.0), "Iy is -1.0; expected"),
        (lambda: spo.Section.rectangle(1.0, 0.0), "rectangle: z is 0.0; expected"),
        (lambda: spo.Section.tube(0.1, 0.2), "wall is 0.2 m; expected at most"),
        (lambda: spo.Material(1.0, 1.0, G=1.0, nu=0.3), "G and nu are both given"),
        (lambda: spo.Material(1.0, 1.0, nu=0.6), "nu is 0.6; expected"),
        (lambda: spo.Material(1.0, 0.0), "E is 0.0; expected"),
        (lambda: spo.beam_modes(-1.0, SECTION, MATERIAL), "length is -1.0; expected"),
        (lambda: modes_of("pinned", 1), "ends is 'pinned'; expected one of 'clamped', 'free', 'element'"),
        (lambda: modes_of(count=0), "at least one mode"),
        (lambda: modes_of(count={"x": 1}), "count has 'x'; expected some of y, z, torsion, axial"),
        (lambda: modes_of(count={"y": 1.5}), "expected integers"),
        (lambda: modes_of(count=-1), "expected integers"),
        (lambda: modes_of("element", 3), "an element has at most"),
        (lambda: modes_of(children={"tip": 2.0}), "place of child 'tip'"),
        (lambda: modes_of(children={"tip": (0.0, 1.0)}), "place of child 'tip'"),
        (lambda: modes_of(damping_ratio=-0.1), "damping_ratio is -0.1; expected"),
        (lambda: modes_of(points=1), "points is 1; expected"),
        (lambda: modes_of(count=11), "22"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words.replace("(", r"\(")):
        call()


def test_other_objects_are_refused():
    with pytest.raises(TypeError, match="section is 3; expected"):
        spo.beam_modes(1.0, 3, MATERIAL)
    with pytest.raises(TypeError, match="material is 'steel'; expected"):
        spo.beam_modes(1.0, SECTION, "steel")


def test_the_rigid_part_is_that_of_a_box():
    mass, com, inertia = spo.beam_modes(LENGTH, SECTION, MATERIAL).rigid
    sides = np.array([LENGTH, 0.02, 0.05]) ** 2
    assert mass == pytest.approx(2700.0 * LENGTH * 0.02 * 0.05) and com == (0.5 * LENGTH, 0.0, 0.0)
    np.testing.assert_allclose(inertia, np.diag(mass / 12.0 * (sides.sum() - sides)), rtol=1e-13)
