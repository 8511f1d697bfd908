"""Which bodies of a Newton model touch each other under SolverSPO."""

import newton
import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support.pair_scenes import WEDGE
from support.pair_touches import hull_of
from support.solver_pair_models import arm, config, free_cube, many, mesh_of, with_table
from warp_spo.errors import UnsupportedError
from warp_spo.examples import newton_grasp
from warp_spo.newton import SolverSPO
from warp_spo.newton.pairs import find_pairs, warn_of_bodies_apart
from warp_spo.newton.worlds import WorldRows


@pytest.fixture(autouse=True)
def on_the_device(device):
    with wp.ScopedDevice(device):
        yield


MISTAKES = {
    "text": ("cube", TypeError, "pairs is 'cube'; expected 'all', or a list of pairs of names"),
    "one name": ([("cube",)], TypeError, "expected 'all', or a list of pairs"),
    "number": ([("cube", 1.5)], TypeError, "expected 'all', or a list of pairs"),
    "nobody": ([("cube", "cup")], ValueError, "pairs holds 'cup', which is no collision shape; expected a pattern"),
    "no number": ([("cube", 99)], ValueError, "pairs holds 99, which is no collision shape; expected a number"),
    "itself": ([("cube", "box of cube")], ValueError, "stands for a shape with itself"),
    "filtered": ([("upper", "lower")], ValueError, "groups or filters keep apart, or which are fixed"),
    "fixed": ([("elbow", "pad")], ValueError, "or which are fixed to each other"),
    "still": ([("post", "post")], ValueError, "stands for a shape with itself"),
    "cone": ([("tin", "cube")], UnsupportedError, "cone 'tin' of body 'tin' with box .*another solver"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_have_names(mistake):
    asked, kind, message = MISTAKES[mistake]
    with pytest.raises(kind, match=message):
        SolverSPO(many(arm(), 1), contacts="none", pairs=asked)


def test_what_steps_cannot_do_has_a_name():
    model = many(arm(), 1)
    for options in (dict(integrator="rk4"), dict(granularity="node")):
        with pytest.raises(UnsupportedError, match="pairs='all' with"):
            SolverSPO(model, contacts="none", pairs="all", **options)
    balls = newton.ModelBuilder()
    for i in range(9):
        ball = balls.add_body(xform=wp.transform(wp.vec3(float(i), 0.0, 0.0), wp.quat_identity()))
        balls.add_shape_sphere(ball, radius=0.1)
    assert len(chosen(many(balls, 1), "all")[0]) == 36
    for _ in range(9, 44):
        balls.add_shape_sphere(balls.add_body(), radius=0.1)
    with pytest.raises(
        UnsupportedError,
        match=r"contact of 946 pairs of shapes .*264 dofs.* is not supported; list those",
    ):
        SolverSPO(many(balls, 1), pairs="all")
    alone = newton.ModelBuilder()
    free_cube(alone, "cube", (0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="pairs='all' finds no two shapes"):
        SolverSPO(many(alone, 1), pairs="all")


def chosen(model, asked):
    """Return the labels of the pairs that a solver would take, without building it."""
    pairs = find_pairs(model, WorldRows(model), spo.from_newton(model), asked, "")
    return [contact.label for contact in pairs._contacts], pairs


def test_all_are_those_that_the_model_lets_collide():
    """No neighbours in the tree, nor what is fixed to each other; what no contact represents is a warning."""
    model = many(arm())
    with pytest.warns(UserWarning, match=r"leaves out capsule 'stick' of body 'upper' with cone 'tin' .* more,"):
        labels, pairs = chosen(model, "all")
    assert labels == ["stick with pad", "stick with box of cube", "stick with ball", "elbow with box of cube",
                      "elbow with ball", "pad with box of cube", "pad with ball", "box of cube with ball"]  # fmt: skip
    assert pairs.rows.shape == (2, 2, 8)
    for world in range(2):
        names = np.array(model.shape_label)[pairs.rows[:, world]].T
        assert [" with ".join(name.rpartition("/")[2] for name in pair) for pair in names] == labels
        assert (model.shape_world.numpy()[pairs.rows[:, world]] == world).all()


def test_bodies_that_pass_through_each_other_are_a_warning(recwarn):
    """Only where no joint connects them; parts of one robot may be meant to pass through each other."""
    model = many(arm())
    with pytest.warns(UserWarning, match=r"such as capsule '.*stick' of body 'upper' with box '.*box of cube' of body"):
        warn_of_bodies_apart(model, WorldRows(model), spo.from_newton(model))
    panda, _ = newton_grasp.panda()
    for pad in range(2):  # pads with each other may collide
        panda.add_shape_collision_filter_pair(pad, 2)
    model = many(panda, 1)
    warn_of_bodies_apart(model, WorldRows(model), spo.from_newton(model))
    assert not recwarn.list


def test_lists_take_patterns_and_numbers():
    """In the order of the list, each pair once; a pattern matches shapes and bodies, in any case."""
    model = many(arm())
    ball = model.shape_label.index(next(label for label in model.shape_label if label.endswith("ball")))
    asked = [("BALL", "*box*"), ("lower", ball), ("cube", "ball"), ("p*d", ball)]
    labels, _ = chosen(model, asked)
    assert labels == ["ball with box of cube", "elbow with ball", "pad with ball"]


def test_pairs_name_all_that_stands_still_or_nothing():
    model, pairs = with_table(post=True), [("table", "cube")]
    with pytest.raises(UnsupportedError, match=r"beside shapes in no pair, such as sphere '.*post' of the world"):
        SolverSPO(model, pairs=pairs)
    with pytest.raises(UnsupportedError, match=r"contacts='ground': left out: sphere '.*post' of the world"):
        SolverSPO(model, pairs=pairs, contacts="ground")
    with pytest.raises(UnsupportedError, match=r"beside contacts='pipeline', such as box '.*table' of the world"):
        SolverSPO(model, pairs=pairs, contacts="pipeline")


def meshes():
    """A ball, a wedge as a mesh and as its hull, a gutter, and a fine globe as its hull."""
    one = newton.ModelBuilder()
    ball = one.add_body(label="ball", xform=wp.transform(wp.vec3(0.0, 0.0, 1.0), wp.quat_identity()))
    one.add_shape_sphere(ball, radius=0.05, label="ball", cfg=config(margin=0.001))
    turned = wp.transform(wp.vec3(0.0, 0.0, 0.3), wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 0.5))
    one.add_shape_mesh(
        -1, mesh=mesh_of(WEDGE), label="wedge", cfg=config(margin=0.002), xform=turned, scale=(2.0, 1.0, 1.0)
    )
    body = one.add_body(label="rock")
    one.add_shape_convex_hull(body, mesh=mesh_of(WEDGE), label="rock", cfg=config())
    outline = [(0, 0), (0.3, 0), (0.3, 0.2), (0.2, 0.2), (0.2, 0.1), (0.1, 0.1), (0.1, 0.2), (0, 0.2)]
    corners = np.array([(x, y, z) for y in (0.0, 0.5) for x, z in outline])
    sides = [t for i in range(8) for t in ((i, (i + 1) % 8, i + 8), ((i + 1) % 8, (i + 1) % 8 + 8, i + 8))]
    one.add_shape_mesh(-1, mesh=newton.Mesh(corners, np.ravel(sides)), label="gutter", cfg=config())
    way = np.random.default_rng(0).normal(size=(100, 3))
    globe = newton.Mesh(way / np.linalg.norm(way, axis=1)[:, None], np.arange(99))
    one.add_shape_convex_hull(-1, mesh=globe, label="globe", cfg=config())
    return many(one)


def test_convex_meshes_are_hulls():
    """Placed and scaled; the margins of both make the ball larger. Others have a name, and are left out of "all"."""
    labels, pairs = chosen(meshes(), [("ball", "wedge"), ("rock", "ball")])
    assert labels == ["ball with wedge", "rock with ball"]
    (first, other), (rock, second) = ((one, one.other) for one in pairs._contacts)
    np.testing.assert_allclose(first.radius, 0.053, atol=1e-8)
    np.testing.assert_allclose(second.radius, 0.051, atol=1e-8)
    c, s = np.cos(0.5), np.sin(0.5)
    wanted = WEDGE * [2.0, 1.0, 1.0] @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [0.0, 0.0, 0.3]
    np.testing.assert_allclose(other.hull, wanted, atol=1e-6)
    np.testing.assert_allclose(rock.hull, WEDGE, atol=1e-7)
    scene = pairs.added_to(spo.from_newton(meshes()))
    assert [len(solid.hull.faces) for pair in scene.contact_pairs for solid in pair.shapes if solid.hull] == [5, 5]
    cases = {
        "gutter": "hull 'gutter' of the world, a mesh that is not convex, is not supported; make it convex",
        "globe": "hull 'globe' of the world, a hull of more than 64 corners in contact with a body, is not",
    }
    for name, message in cases.items():
        with pytest.raises(UnsupportedError, match=message):
            chosen(meshes(), [("ball", name)])
    _, pairs = chosen(meshes(), [("rock", "wedge")])
    (rock,) = pairs._contacts
    (grown, middle), (hull, before) = hull_of(rock.other.hull), hull_of(other.hull)
    for normal, offset in zip(hull.normals, hull.offsets + hull.normals @ before, strict=True):
        at = (grown.normals @ normal).argmax()  # the margin of the wedge moves its faces
        np.testing.assert_allclose(grown.offsets[at] + grown.normals[at] @ middle, offset + 0.002, atol=1e-6)
