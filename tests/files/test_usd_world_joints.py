"""Joints of USD files between a body and the world have their zero where the file writes it."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.usd_texts import HEAD, body, joint, loaded, stage
from warp_spo.reference.dense import Dense

pytest.importorskip("pxr.Usd")
pytest.importorskip("newton_usd_schemas")
pytestmark = pytest.mark.filterwarnings("ignore::newton.NewtonWarning")

SINGLE = 2e-6  # the importer computes in float32
ROOT = "PhysicsArticulationRootAPI"
PLACE = "point3f physics:localPos{0} = (1, 2, 3)\nquatf physics:localRot{0} = (0.9659258, 0.2588190, 0, 0)\n"
OWN = "point3f physics:localPos{0} = (0.1, 0, 0.2)\nquatf physics:localRot{0} = (0.9238795, 0, 0, 0.3826834)\n"
LIMITS = "float physics:lowerLimit = -45\nfloat physics:upperLimit = 45\n"
STATIC = """
    def Xform "wall" {
        double3 xformOp:translate = (4, 5, 6)
        float3 xformOp:rotateXYZ = (0, 40, 0)
        float3 xformOp:scale = (2, 2, 2)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]
    }
"""


def turn(axis, degrees):
    """Return the pose that turns about a coordinate axis of the frame before it [4, 4]."""
    pose, (i, j), angle = np.eye(4), [(1, 2), (2, 0), (0, 1)][axis], np.radians(degrees)
    pose[[i, j], [i, j]], pose[i, j], pose[j, i] = np.cos(angle), -np.sin(angle), np.sin(angle)
    return pose


def move(*place):
    pose = np.eye(4)
    pose[:3, 3] = place
    return pose


ANCHOR, IN_BODY = move(1, 2, 3) @ turn(0, 30), move(0.1, 0, 0.2) @ turn(2, 45)


def door(name="arm", hinge="j", flipped=False, wall="", more=LIMITS, apis=(), joint_apis=(), kind="Revolute"):
    """Return the prims of a body, saved as the joint does not hold it at zero, and its joint to the world."""
    turned = body(name, apis=apis, place=(1, 2, 3)).replace(
        'uniform token[] xformOpOrder = ["xformOp:translate"]',
        'float3 xformOp:rotateXYZ = (0, 30, 0)\nuniform token[] xformOpOrder = ["xformOp:translate", '
        '"xformOp:rotateXYZ"]',
    )
    own, world = int(not flipped), int(flipped)
    ends = (name, wall) if flipped else (wall, name)
    text = PLACE.format(world) + OWN.format(own) + more
    return turned + joint(hinge, *(end or None for end in ends), text, kind, joint_apis)


def body_at(scene, q, label="/World/arm"):
    return Dense(scene, q).body_matrix[scene.body_labels.index(label)]


@pytest.mark.parametrize("articulation", ["above", "none", "body", "joint"])
@pytest.mark.parametrize("flipped", [False, True])
def test_a_file_saved_elsewhere_than_at_zero(articulation, flipped, tmp_path):
    """At q the body is at anchor, turn by q about X, inverse of the anchor in the body; turned the other way with
    the world as body1.
    """
    prims = door(
        flipped=flipped,
        apis=(ROOT,) if articulation == "body" else (),
        joint_apis=(ROOT,) if articulation == "joint" else (),
    )
    scene, warning = loaded(
        tmp_path, stage(prims, root=f'(prepend apiSchemas = ["{ROOT}"])' if articulation == "above" else "")
    )
    assert not warning
    for q in (0.0, 0.4):
        wanted = ANCHOR @ turn(0, np.degrees(-q if flipped else q)) @ np.linalg.inv(IN_BODY)
        np.testing.assert_allclose(body_at(scene, [q]), wanted, atol=SINGLE)
    np.testing.assert_allclose(np.degrees(scene.values["joint_limit_upper"]), [[45]], atol=1e-4)


def test_prims_that_stand_still_units_and_an_up_axis(tmp_path):
    """A static prim's pose and scale count, centimetres are converted, and Y up becomes Z up."""
    wall = move(4, 5, 6) @ turn(1, 40) @ np.diag([2, 2, 2, 1])
    scene, _ = loaded(tmp_path, stage(STATIC, door(wall="wall")))
    wanted = wall @ ANCHOR
    wanted[:3, :3] /= 2
    np.testing.assert_allclose(body_at(scene, [0.0]), wanted @ np.linalg.inv(IN_BODY), atol=5 * SINGLE)
    head = HEAD.replace("metersPerUnit = 1", "metersPerUnit = 0.01").replace('upAxis = "Z"', 'upAxis = "Y"')
    scene, _ = loaded(tmp_path, stage(door(), head=head))
    wanted = turn(0, 90) @ ANCHOR @ np.linalg.inv(IN_BODY)
    wanted[:3, 3] /= 100
    np.testing.assert_allclose(body_at(scene, [0.0]), wanted, atol=SINGLE)


def test_a_place_of_zero_counts_but_of_a_fixed_joint(tmp_path):
    """Zero, if written, is the world's origin; unwritten, or of a fixed joint, it is where the body stands."""
    zero = "point3f physics:localPos0 = (0, 0, 0)\nquatf physics:localRot0 = (1, 0, 0, 0)\n"
    stands = move(1, 2, 3) @ turn(1, 30)
    beside = body("wing"), joint("k", "arm", "wing", kind="Fixed")
    for kind, written, wanted in (
        ("Revolute", zero, np.linalg.inv(IN_BODY)),
        ("Revolute", "", stands),
        ("Fixed", zero, stands),
        ("Fixed", "", stands),
    ):
        for more in ((), beside):
            prims = door(kind=kind, more="").replace(PLACE.format(0), written)
            scene, _ = loaded(tmp_path, stage(prims, *more))
            np.testing.assert_allclose(body_at(scene, np.zeros(scene.dof_count)), wanted, atol=SINGLE)


def test_several_robots_and_several_joints_of_a_body(tmp_path):
    """Two doors of one file keep their anchors; joints of one anchor make one joint there, whatever frame is first."""
    scene, _ = loaded(tmp_path, stage(door(), door("other", "k"), root=""))
    for label in ("/World/arm", "/World/other"):
        np.testing.assert_allclose(
            body_at(scene, [0.0, 0.0], label), ANCHOR @ np.linalg.inv(IN_BODY), atol=SINGLE, err_msg=label
        )


@pytest.mark.parametrize("up", ["Y", "Z"])
@pytest.mark.parametrize("root", ["", f'(prepend apiSchemas = ["{ROOT}"])'])
def test_several_joints_of_a_body(up, root, tmp_path):
    """They make one joint at their anchor, turns in the order of the file, each about its own axis.

    The importer takes the frame of the one that comes first by its name, here the second, whose Z is the other's Y.
    """
    second = joint("a", None, "arm", 'uniform token physics:axis = "Z"\n' + PLACE.format(0) + OWN.format(1))
    for end, frame in (("0", ANCHOR), ("1", IN_BODY)):
        x, y, z, w = Rotation.from_matrix((frame @ turn(0, -90))[:3, :3]).as_quat()
        second = re.sub(f"localRot{end} = .*", f"localRot{end} = ({w}, {x}, {y}, {z})", second)
    text = stage(door(), second, root=root, head=HEAD.replace('upAxis = "Z"', f'upAxis = "{up}"'))
    scene, _ = loaded(tmp_path, text)
    wanted = ANCHOR @ turn(0, np.degrees(0.3)) @ turn(1, np.degrees(-0.5)) @ np.linalg.inv(IN_BODY)
    if up == "Y":
        wanted = turn(0, 90) @ wanted
    np.testing.assert_allclose(body_at(scene, [0.3, -0.5]), wanted, atol=SINGLE)


def test_a_loop_closed_at_the_world(tmp_path):
    """Its anchor is in the world's frame, whatever moves the articulation's root."""
    root = f'(prepend apiSchemas = ["{ROOT}"])'
    moved = "double3 xformOp:translate = (10, 0, 0)\nuniform token[] xformOpOrder = ["
    moved += '"xformOp:translate"]\n'
    parts = body("wing"), joint("k", "arm", "wing"), joint(
        "close", None, "wing", PLACE.format(0) + "bool physics:excludeFromArticulation = 1"
    )  # fmt: skip
    text = stage(door(), *parts).replace(f'def Xform "World" {root}\n{{', f'def Xform "World" {root}\n{{\n{moved}')
    scene, _ = loaded(tmp_path, text)
    (loop,) = scene.loops
    assert loop.parent == -1
    np.testing.assert_allclose(loop.parent_pose[:3], [1, 2, 3], atol=SINGLE)
