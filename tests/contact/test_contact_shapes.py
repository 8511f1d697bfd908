"""Every kind of contact shape answers what readers of files, contacts with the ground, pairs and pictures ask."""

import numpy as np
import pytest

import warp_spo as spo
from support.pair_scenes import SHAPE_ARGUMENTS
from warp_spo.mujoco.collision_shapes import GEOMS
from warp_spo.newton.files.urdf_shapes import READERS
from warp_spo.newton.model_contacts import KINDS
from warp_spo.scene.collision_shapes import CollisionShape, contacts_of
from warp_spo.scene.contact_shapes import ARGUMENTS, SHAPES, kinds_in

HALF = np.sqrt(0.5)
POSE = (0.3, -0.2, 0.1, HALF, 0.0, 0.0, HALF)
SIZES = {"radius": 0.1, "half_length": 0.3, "half_x": 0.1, "half_y": 0.2, "half_z": 0.3}
MESH = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.2, 0.2) for z in (-0.3, 0.3)])
OF_SOURCES = [kind for kind, shape in SHAPES.items() if shape.names]


def shape_of_source(kind, **more):
    """Return a shape as a reader of a file describes it."""
    sizes = SHAPES[kind].sizes
    return CollisionShape("", 0, kind, POSE, MESH if sizes is None else [SIZES[name] for name in sizes], **more)


def lowest(contacts, direction):
    """Return how far the contacts' spheres reach along a direction."""
    return max((one.positions @ direction).max() + one.radius for one in contacts)


def test_readers_know_all_names():
    assert {name.lower() for name in kinds_in("mujoco")} <= set(GEOMS.values())
    assert set(kinds_in("newton").values()) <= set(KINDS.values())  # keys are looked up when the module is loaded
    for kind in kinds_in("urdf").values():
        assert set(SHAPES[kind].sizes or ()) <= READERS.keys()


@pytest.mark.parametrize("kind", OF_SOURCES)
def test_margins_move_the_surface(kind):
    """Along an axis of the shape the surface lies farther out by the margin."""
    direction = np.array([1.0, 0.0, 0.0])  # an axis of POSE, too
    bare, thick = (contacts_of(shape_of_source(kind, rounding=margin)) for margin in (0.0, 0.02))
    assert np.isclose(lowest(bare, direction), POSE[0] + 0.1)
    assert np.isclose(lowest(thick, direction), POSE[0] + 0.12)


@pytest.mark.parametrize("kind", ARGUMENTS)
def test_arguments_give_the_shape_again(kind):
    made = spo.Contact(0, **{kind: SHAPE_ARGUMENTS[kind]})
    again = spo.Contact(0, **made.shape.arguments())
    np.testing.assert_array_equal(again.positions, made.positions)
    assert again.radius == made.radius
    drawn, sizes, pose = made.shape.primitive(0.01)
    count = {"sphere": 1, "capsule": 2, "cylinder": 2, "cone": 2, "box": 3, "ellipsoid": 3}[drawn]
    assert len(sizes) == count and min(sizes) > 0.0 and len(pose) == 7
    try:
        samples = made.shape.convex("test").samples
    except spo.UnsupportedError:  # a shape for the ground alone
        return
    assert np.allclose(samples.mean(axis=0), pose[:3])  # it is drawn where the narrow phase has it
