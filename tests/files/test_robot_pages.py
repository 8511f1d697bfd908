"""The page of a robot, driven through viser's handles without a browser, beside MuJoCo and closed forms."""

import json
import subprocess
import sys
import warnings

import mujoco
import numpy as np
import pytest

import warp_spo as spo
from support.usd_texts import ARM_OF_MESHES
from warp_spo.newton import shipped
from warp_spo.reference.rotations import rotation
from warp_spo.viewing.appearance import file_appearance
from warp_spo.viewing.overlays import inertia_boxes
from warp_spo.viewing.robot_view import view

pytest.importorskip("viser", reason="needs the extra view")
SENT = 1e-6  # of places that the server sends as float32, within 1 m [m]
LEG = """
<mujoco><option timestep="0.002"/><worldbody>
  <geom name="floor" type="plane" size="5 5 0.1"/>
  <body name="trunk" pos="0 0 0.6"><freejoint/>
    <geom type="box" size="0.2 0.1 0.05" mass="4" rgba="1 0 0 1"/>
    <body name="thigh" pos="0.15 0 0"><joint name="hip" axis="0 1 0" range="-60 60"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.03" mass="1" contype="0" conaffinity="0"/>
      <body name="shank" pos="0 0 -0.2"><joint name="knee" axis="0 1 0" range="-120 -10"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.5"/>
        <geom type="cylinder" pos="0 0 -0.2" size="0.03 0.04" group="3" mass="0"/></body></body></body>
</worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def leg(tmp_path_factory):
    """The file of a trunk on one leg, and its page."""
    file = tmp_path_factory.mktemp("leg") / "leg.xml"
    file.write_text(LEG)
    page = view(file, port=18080)
    yield file, page
    page.close()


def sent_places(page, layer="what the file draws"):
    """Places and quaternions wxyz that the server has sent for the bodies of a layer, by body."""
    return {b: (h.batched_positions[0], h.batched_wxyzs[0]) for b, h in page.layers[layer].handles if b >= 0}


def test_a_slider_turns_the_link_to_where_mujoco_says(leg):
    file, page = leg
    page.back()
    knee, hip = (page.sliders.by_label[name] for name in ("knee", "hip"))
    assert (hip.min, hip.max) == pytest.approx(np.radians([-60, 60]))
    assert (knee.min, knee.max) == pytest.approx(np.radians([-120, -10]))
    hip.value, knee.value = 0.4, -1.1
    page.tick()
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    data.qpos[:3], data.qpos[3:7], data.qpos[7:] = page.q[:3], [1, 0, 0, 0], (0.4, -1.1)
    mujoco.mj_kinematics(model, data)
    found = sent_places(page)
    assert set(found) == {0, 1, 2}
    for body, (place, turn) in found.items():
        assert np.allclose(place, data.xpos[body + 1], atol=SENT, rtol=0)
        assert np.allclose(turn * np.sign(turn[0]), data.xquat[body + 1], atol=SENT, rtol=0)
    assert np.allclose(page.poses[:, :3], data.xpos[1:], atol=SENT, rtol=0)
    turned = page.sliders.by_label[page.scene.dof_labels[5]]
    turned.value = 0.7  # about z
    page.tick()
    assert np.allclose(page.q[3:7], [0, 0, np.sin(0.35), np.cos(0.35)])


def test_what_a_file_draws_and_what_collides_are_apart(leg):
    file, page = leg
    found = file_appearance(file, page.scene)
    drawn, collision = ({s.body: s for s in some} for some in (found.drawn, found.collision))
    assert set(drawn) == {0, 1, 2} and set(collision) == {0, 2}  # the thigh collides with nothing
    assert drawn[0].color == (1.0, 0.0, 0.0)
    assert np.allclose(np.abs(drawn[0].vertices).max(axis=0), [0.2, 0.1, 0.05])
    assert drawn[2].vertices[:, 2].min() == pytest.approx(-0.22) and drawn[2].vertices[:, 2].max() == pytest.approx(
        0.02
    )
    assert collision[2].vertices[:, 2].min() == pytest.approx(-0.24)  # the cylinder, which is not drawn
    page.boxes["collision shapes"].value = True
    page.tick()
    assert all(handle.visible for _, handle in page.layers["collision shapes"].handles)
    assert np.allclose(sent_places(page, "collision shapes")[2][0], sent_places(page)[2][0])


def test_a_file_without_a_ground_stands_on_one(tmp_path):
    """Its feet touch the plane z = 0, and it falls onto it; without contact nothing would hold it."""
    file = tmp_path / "leg.xml"
    file.write_text("".join(line for line in LEG.splitlines() if 'type="plane"' not in line))
    page = view(file, port=18080)
    try:
        assert len(page.scene.contact_points) > 0 and page.scene.ground.height == 0.0
        assert any("no ground" in note for note in page.notes)
    finally:
        page.close()


def test_overlays_show_points_frames_and_centres_of_mass(leg):
    _, page = leg
    page.back()
    for name in page.overlays.names:
        page.boxes[name].value = True
    page.tick()
    points = page.overlays.handles["contact points"][0]
    assert len(points.batched_positions) == len(page.scene.contact_points) > 0
    foot = [i for i, point in enumerate(page.scene.contact_points) if point.body == 2]
    assert points.batched_positions[foot, 2].min() == pytest.approx(min(page.poses[2, 2] - 0.22, 9), abs=0.05)
    assert np.allclose(page.overlays.handles["frames"][0].batched_positions, page.poses[:, :3], atol=SENT)
    centres = page.overlays.handles["centres of mass"][0].batched_positions
    wanted = [p[:3] + rotation(p[3:]) @ b.com for p, b in zip(page.poses, page.scene.bodies, strict=True)]
    assert np.allclose(centres, wanted, atol=SENT)
    page.boxes["frames"].value = False
    page.tick()
    assert not page.overlays.handles["frames"][0].visible


def test_the_inertia_box_of_a_box_is_the_box():
    halves = np.array([0.3, 0.2, 0.05])
    moments = 5.0 / 3.0 * (np.sum(halves**2) - halves**2)
    turn = rotation(np.array([0.5, 0.5, 0.5, 0.5]))
    scene = spo.Scene(
        [spo.Body(5.0, com=(1, 2, 3), inertia=turn @ np.diag(moments) @ turn.T)], [spo.Hinge("free", -1, 0)]
    )
    middles, turns, found = inertia_boxes(scene)
    assert np.allclose(middles, [[1, 2, 3]]) and np.allclose(np.sort(found[0]), np.sort(halves))
    axes = rotation(turns[0])
    wanted, own = turn @ np.diag(moments) @ turn.T, 5.0 / 3.0 * (np.sum(found[0] ** 2) - found[0] ** 2)
    assert np.allclose(axes @ np.diag(own) @ axes.T, wanted)


def test_a_robot_falls_is_held_and_steps(leg):
    """In the air its centre of mass falls as a stone does; pause holds, a step is one dt; forces carry the weight."""
    _, page = leg
    page.back()
    page.tick()
    com = page.motion is None and page._kinematics.com(page.q[None])[0, 2]
    page.drop()
    page.tick(0.1)
    motion = page.motion
    assert motion.time == pytest.approx(0.1)
    steps = 50  # semi-implicit steps fall by g dt^2 n (n + 1) / 2
    fallen = com + 0.3 - motion.dyn.com(motion.q)[0, 2]
    assert fallen == pytest.approx(9.81 * motion.dt**2 * steps * (steps + 1) / 2, rel=1e-6)
    page.pause()
    q = page.q.copy()
    page.tick(0.1)
    assert (page.q == q).all() and motion.time == pytest.approx(0.1)
    page.step_once()
    page.tick(0.1)
    assert motion.time == pytest.approx(0.1 + motion.dt) and (page.q != q).any()
    page.pause()
    for _ in range(30):
        page.tick(0.1)
    assert motion.status.name in ("OK", "NOT_SETTLED", "DIGITS")
    assert motion.contact_forces[:, 2].sum() == pytest.approx(5.5 * 9.81, rel=0.05) and page.arrows.handle.visible
    assert sum(page.energy.rows[0][1:3]) == pytest.approx(page.energy.rows[0][3])
    place = motion.dyn.com(motion.q)[0].copy()
    page.pull(0)
    page._grip.position = (*page._pull.target[:2], page._pull.target[2] + 0.5)
    for _ in range(10):
        page.tick(0.1)
    assert motion.dyn.com(motion.q)[0, 2] > place[2] + 0.05
    page.back()
    page.tick()
    assert page.motion is None and page._grip is None


def test_warnings_of_the_loader_and_values_stand_in_the_text(tmp_path):
    file = tmp_path / "arm.urdf"
    file.write_text(
        '<robot name="arm"><link name="base"/><link name="a|b"><inertial><mass value="2"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
        '<visual><geometry><mesh filename="gone.stl"/></geometry></visual></link>'
        '<joint name="turn" type="revolute"><parent link="base"/><child link="a|b"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="2" effort="0" velocity="3"/></joint></robot>'
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # they are on the page
        page = view(file, port=18080)
    try:
        text = page.text.content
        assert "lets no drive" in text and "draws nothing" in text and "gone.stl" in text and "a\\|b" in text
        assert (page.sliders.by_label["arm/turn"].min, page.sliders.by_label["arm/turn"].max) == (-1.0, 2.0)
    finally:
        page.close()


def test_meshes_of_packages_are_drawn_and_a_fixed_robot_stands_on_the_ground(tmp_path):
    """A URDF names its package in two ways and one mesh that is nowhere; its leg hangs 2 m below its fixed root."""
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "leg.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 -1\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    )
    body = '<inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    mesh = '<{}><geometry><mesh filename="package://{}" scale="2 2 2"/></geometry></{}>'
    shapes = [("visual", "/meshes/leg.obj"), ("collision", "meshes/leg.obj"), ("visual", "meshes/lost.stl")]
    file = tmp_path / "leg.urdf"
    file.write_text(
        f'<robot name="r"><link name="hip">{body}</link><link name="leg">{body}'
        + "".join(mesh.format(tag, name, tag) for tag, name in shapes)
        + '</link><joint name="turn" type="continuous"><parent link="hip"/><child link="leg"/><axis xyz="0 0 1"/>'
        "</joint></robot>"
    )
    page = view(file, port=18080)
    try:
        (leg,) = page.layers["what the file draws"].handles
        assert leg[0] == page.scene.body_labels.index("r/leg") and np.allclose(leg[1].vertices.min(axis=0), [0, 0, -2])
        assert any("lost.stl" in note for note in page.notes)
        assert page.scene.ground.height == pytest.approx(-2.0)
        points = [point.position[2] for point in page.scene.contact_points]
        assert min(points) == pytest.approx(-2.0)
    finally:
        page.close()


def test_meshes_of_a_usd_file_are_drawn_where_openusd_has_them(tmp_path):
    """In centimetres with y up, below a turned and stretched frame; the page turns z up, and a slider the link."""
    usd, geometry = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    file = tmp_path / "arm.usda"
    file.write_text(ARM_OF_MESHES)
    stage, places, wanted = usd.Stage.Open(str(file)), geometry.XformCache(), []
    for path in ("/Arm/base/look/body", "/Arm/link/blade"):
        prim = stage.GetPrimAtPath(path)
        matrix = np.array(places.GetLocalToWorldTransform(prim))
        x, y, z = 0.01 * (np.array(geometry.Mesh(prim).GetPointsAttr().Get()) @ matrix[:3, :3] + matrix[3, :3]).T
        wanted.append(np.column_stack([x, -z, y]))
    page = view(file, port=18080)
    try:
        assert not any("metersPerUnit" in note for note in page.notes)
        look = file_appearance(file, page.scene)
        for some, bodies in ((look.drawn, (0, 1)), (look.collision, (1,))):
            assert tuple(surface.body for surface in some) == bodies
            for surface in some:
                pose = page.poses[surface.body]
                found = surface.vertices @ rotation(pose[3:]).T + pose[:3]
                np.testing.assert_allclose(sorted(found.tolist()), sorted(wanted[surface.body].tolist()), atol=1e-6)
        red, green, blue = look.drawn[0].color
        assert red > 0.9 > 0.5 > green > blue
        (slider,) = page.sliders.by_label.values()
        slider.value = 0.5
        page.tick()
        axis = rotation(page.poses[1][3:]) @ rotation(page._kinematics.body_poses(np.zeros((1, 1)))[0, 1, 3:]).T
        about_y = [[np.cos(0.5), 0.0, np.sin(0.5)], [0.0, 1.0, 0.0], [-np.sin(0.5), 0.0, np.cos(0.5)]]
        np.testing.assert_allclose(axis, np.transpose(about_y), atol=1e-6)  # the file's z is -y of the page
    finally:
        page.close()


def test_a_scene_by_hand_with_a_loop_stays_closed():
    """The slider of a four-bar linkage moves all of it; the loop is closed to a micrometre."""
    from warp_spo.examples import fourbar

    page = view(fourbar.scene(), port=18080)
    try:
        slider = next(iter(page.sliders.by_label.values()))
        before, wanted = page.q.copy(), slider.value + 0.1
        slider.value = wanted
        page.tick()
        assert np.abs(page.q - before).max() > 0.05
        assert np.abs(page._kinematics.closure_error(page.q[None])).max() < 1e-6
    finally:
        page.close()


def test_flexible_bodies_bend_to_the_bodies_that_they_carry():
    """The line of a bent boom begins at its frame and ends where the jib begins, and so on to the load."""
    from warp_spo.examples import crane

    page = view(crane.scene(), port=18080)
    try:
        random = np.random.default_rng(0)
        for handle in page.sliders.by_label.values():
            handle.value = random.uniform(0.5 * handle.min, 0.5 * handle.max)
        page.tick()
        assert page.flexible.bodies == [0, 1, 2]
        assert {body for body, _ in page.layers["what the file draws"].handles} == {3}  # no straight bone over a line
        for number, body in enumerate(page.flexible.bodies):
            line = page.flexible.points(number, page.q, page.poses)
            assert np.allclose(line[0], page.poses[body, :3]) and np.allclose(line[-1], page.poses[body + 1, :3])
            assert np.linalg.norm(line[-1] - line[0]) > 5.0
        sent = page.flexible.handle.points
        assert np.allclose(sent[-1, 1], page.poses[3, :3], atol=1e-5)  # float32, within 40 m
    finally:
        page.close()


def test_two_pages_take_two_ports_of_this_machine(leg):
    _, page = leg
    other = view(spo.load(shipped("cartpole")), port=page.page.server.get_port())
    try:
        assert other.page.server.get_port() > page.page.server.get_port()
        assert {one.page.server.get_host() for one in (page, other)} == {"127.0.0.1"}
    finally:
        other.close()


def test_without_viser_the_error_names_the_extra_and_nothing_is_imported_before():
    code = (
        "import sys, json; sys.modules['viser'] = None; import warp_spo as spo; import warp_spo.viewing\n"
        "try: spo.view('robot.urdf')\n"
        "except ImportError as error: text = str(error)\n"
        "print(json.dumps([text, 'newton' in sys.modules]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    text, newton = json.loads(done.stdout.splitlines()[-1])
    assert text.endswith("pip install warp_spo[view]") and not newton
