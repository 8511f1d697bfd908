"""Contacts from the collision shapes of files and models: against MuJoCo's compiled geoms, and against Newton's shapes.

A shape's contacts must reach as deep in every pose as the shape itself: the lowest height of the points of all contacts
of one shape is compared with that of MuJoCo's geom at the same state, in random states.
"""

import warnings

import mujoco
import newton
import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from warp_spo.scene.extreme_points import farthest_points

EXACT = 1e-12  # float64 on both sides; sizes of a metre
SINGLE = 3e-6  # MuJoCo keeps the vertices of meshes in float32
WEDGE = [(-0.1, -0.05, 0), (0.1, -0.05, 0), (0.1, 0.05, 0), (-0.1, 0.05, 0), (0.08, 0, 0.12), (-0.08, 0.02, 0.1)]
MJCF = """<mujoco>
  <compiler angle="degree" eulerseq="zyx"/>
  <asset><mesh name="wedge" vertex="{wedge}" scale="1.5 1 -0.5"/>
    <hfield name="hills" nrow="3" ncol="4" size="3 2 .5 .1"/></asset>
  <default><geom friction="0.7"/>
    <default class="shin"><geom type="capsule" size=".03" friction="0.4"/></default></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" pos="0 0 .1" euler="0 0 10"/>
    <geom name="table" type="box" size="1 1 .1" pos="9 0 0"/>
    <body name="trunk" pos="0.1 0.2 1"><freejoint/>
      <inertial mass="3" pos=".01 .02 .03" fullinertia=".2 .25 .3 .01 .02 .03"/>
      <geom name="ball" type="sphere" size=".2" pos=".1 -.2 .05"/>
      <geom name="can" type="cylinder" size=".1 .3" axisangle="1 2 3 40" priority="1" friction="0.2"/>
      <geom name="slab" type="box" size=".3 .2 .1" pos="0 0 .1" euler="10 20 30"/>
      <geom name="shell" type="ellipsoid" size=".3 .2 .1" zaxis="1 1 0" condim="1"/>
      <geom name="skin" type="sphere" size="9" contype="0" conaffinity="0"/>
      <body name="mount" pos="0 .1 -.2" quat=".8 0 .6 0">
        <geom name="lens" type="sphere" size=".05" pos=".1 .1 .1"/>
        <geom name="prism" type="mesh" mesh="wedge" pos=".2 0 0" euler="0 30 0" mass="0"/>
      </body>
      <body name="shin" pos=".2 0 -.1"><joint axis="0 1 0" pos="0 0 .1"/><joint axis="1 0 0"/>
        <geom name="rod" class="shin" fromto="0 0 0 .1 .2 -.4"/>
        <geom name="toe" type="sphere" size=".04" pos=".1 .2 -.5"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""
SUPPORT = {  # lowest height of a geom of these sizes about its centre; r: third row of its rotation
    mujoco.mjtGeom.mjGEOM_SPHERE: lambda s, r: -s[0],
    mujoco.mjtGeom.mjGEOM_CAPSULE: lambda s, r: -s[0] - s[1] * abs(r[2]),
    mujoco.mjtGeom.mjGEOM_BOX: lambda s, r: -np.abs(r) @ s,
    mujoco.mjtGeom.mjGEOM_CYLINDER: lambda s, r: -s[1] * abs(r[2]) - s[0] * np.hypot(r[0], r[1]),
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: lambda s, r: -np.linalg.norm(r * s),
}


def quiet(call, *given, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return call(*given, **options)


def compiled(text=MJCF):
    return mujoco.MjModel.from_xml_string(text.format(wedge=" ".join(str(x) for point in WEDGE for x in point)))


def lowest(scene, q):
    """Return the lowest height of the points of the contacts of each label, by label, at a state."""
    dyn = spo.Dynamics(scene, scene.worlds, dtype="float64")
    poses = dyn.frame_poses(np.tile(q, (scene.worlds, 1)), list(range(scene.body_count)))[0]
    found = {}
    for contact in scene.contacts:
        x, y, z, w = poses[contact.body, 3:]
        row = np.array([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)])
        height = poses[contact.body, 2] + (contact.positions @ row).min() - contact.radius
        found[contact.label] = min(found.get(contact.label, np.inf), height)
    return found


def geoms(model, qpos):
    """Return the lowest height of each geom of a body that can move, by its name."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    found = {}
    for geom in range(model.ngeom):
        kind = int(model.geom_type[geom])
        if model.body_weldid[model.geom_bodyid[geom]] == 0:
            continue
        row = data.geom_xmat[geom].reshape(3, 3)[2]
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            first, count = (getattr(model, f"mesh_vert{x}")[model.geom_dataid[geom]] for x in ("adr", "num"))
            low = (model.mesh_vert[first : first + count].astype(float) @ row).min()
        else:
            low = SUPPORT[kind](model.geom_size[geom], row)
        found[model.geom(geom).name or geom] = data.geom_xpos[geom, 2] + low
    return found


def random_q(model, rng):
    qpos = rng.uniform(-1.0, 1.0, model.nq)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    return qpos


def test_shapes_of_a_mujoco_model_are_its_geoms():
    """Types, frames, fixed children, fromto, classes, meshes that MuJoCo recentres; round ones to their points."""
    model, rng = compiled(), np.random.default_rng(1)
    scene = quiet(spo.from_mujoco, model, contacts="ground", points=64)
    assert {c.label for c in scene.contacts} == {"ball", "can", "slab", "shell", "lens", "prism", "rod", "toe"}
    for _ in range(5):
        qpos = random_q(model, rng)
        want = geoms(model, qpos)
        q = qpos[[0, 1, 2, 4, 5, 6, 3, *range(7, model.nq)]]
        for name, height in lowest(scene, q).items():
            round_one = {"can": 0.1 * (1 - np.cos(np.pi / 32)), "shell": 0.015}.get(name, 0.0)
            tolerance = SINGLE if name == "prism" else EXACT
            assert want[name] - tolerance <= height <= want[name] + round_one + tolerance, name


def test_friction_is_that_of_mujoco_on_its_ground():
    """The larger of both, or that of the geom with priority, or none of one dimension; the plane is the ground."""
    scene = quiet(spo.from_mujoco, compiled(), contacts="ground")
    friction = {c.label: c.friction for c in scene.contacts}
    assert friction["ball"] == 0.7 and friction["rod"] == 0.7 and friction["can"] == 0.2
    pair = '<contact><pair geom1="shell" geom2="floor" friction="0.9 0.9 0.1 0.1 0.1"/></contact></mujoco>'
    paired = MJCF.replace('condim="1"', 'contype="0" conaffinity="0"').replace("</mujoco>", pair)
    friction = {c.label: c.friction for c in quiet(spo.from_mujoco, compiled(paired), contacts="ground").contacts}
    assert friction["shell"] == 0.9
    frictionless = MJCF.replace('name="floor"', 'name="floor" condim="1"')
    friction = {c.label: c.friction for c in quiet(spo.from_mujoco, compiled(frictionless), contacts="ground").contacts}
    assert friction["shell"] == 0.0 and friction["ball"] == 0.7
    np.testing.assert_allclose(scene.ground.height, 0.1 * np.cos(np.radians(10)), atol=EXACT)
    np.testing.assert_allclose(
        np.abs(scene.ground.normal), [0, np.sin(np.radians(10)), np.cos(np.radians(10))], atol=EXACT
    )


def test_patterns_choose_shapes():
    """By the names of shapes, bodies and meshes; the first pattern says how many points."""
    model = compiled()
    labels = lambda **options: [c.label for c in quiet(spo.from_mujoco, model, **options).contacts]  # noqa: E731
    assert labels(contacts="SHIN") == ["rod", "toe"]
    assert labels(contacts=["toe", "wedge", "l?ns"]) == ["lens", "prism", "toe"]
    scene = quiet(spo.from_mujoco, model, contacts={"can": 6, "prism": 5}, ground=spo.Plane(0.3))
    assert [len(c.placements(None)) for c in scene.contacts] == [4, 5] and scene.ground.height == 0.3


@pytest.mark.parametrize("source", ["mujoco", "newton", "urdf"])
def test_ground_is_the_shapes_of_all_bodies(source, urdf):
    """Points and frictions of "ground" are those of the pattern "*" on the source's own plane; ["ground"] is a name."""
    read = {
        "mujoco": lambda contacts: quiet(spo.from_mujoco, compiled(), contacts=contacts),
        "newton": lambda contacts: quiet(spo.from_newton, newton_model(), contacts=contacts),
        "urdf": lambda contacts: quiet(spo.load, urdf, floating=True, contacts=contacts),
    }[source]
    found, wanted = read("ground"), read("*")
    assert len(found.contact_points) == len(wanted.contact_points) > 4 and not found.contact_pairs
    assert [c.label for c in found.contacts] == [c.label for c in wanted.contacts]
    np.testing.assert_array_equal(found.values["contact_friction"], wanted.values["contact_friction"])
    with pytest.raises(ValueError, match=r"contacts='ground' matches no collision shape"):
        read(["ground"])


@pytest.mark.parametrize("options, error, words", [
    (dict(contacts="hoof"), ValueError, r"contacts='hoof' matches no collision shape .*'trunk', 'mount', 'shin'"),
    (dict(contacts="skin"), ValueError, "contacts='skin' matches no collision shape"),
    (dict(contacts=3), TypeError, r"contacts is 3; expected 'ground', True, a pattern such as '\*foot\*'"),
    (dict(contacts=[]), TypeError, "expected 'ground', True"),
    (dict(contacts="toe", points=0), ValueError, "points is 0; expected an integer, 1 or more"),
    (dict(ground=spo.Plane()), ValueError, "ground is given without contacts"),
])  # fmt: skip
def test_what_cannot_be_chosen_is_an_error(options, error, words):
    with pytest.raises(error, match=words):
        quiet(spo.from_mujoco, compiled(), **options)


def test_what_is_left_out_is_said_by_name():
    with pytest.warns(UserWarning, match=r"left out: box 'table' of the world$"):
        spo.from_mujoco(compiled(), contacts="ground")
    wall = MJCF.replace('euler="0 0 10"', 'zaxis="1 0 0"')
    words = "plane 'floor' of the world, steeper than 60 degrees, so that the ground is the plane z = 0; box 'table' of"
    with pytest.warns(UserWarning, match=f"left out: {words} the world$"):
        scene = spo.from_mujoco(compiled(wall), contacts="ground")
    assert scene.ground.height == 0.0
    two = MJCF.replace('<geom name="table"', '<geom name="hill" type="hfield" hfield="hills"/><geom name="table"')
    with pytest.raises(spo.UnsupportedError, match="several grounds: plane 'floor' of the world, height field 'hill'"):
        quiet(spo.from_mujoco, compiled(two), contacts="ground")


def test_a_height_field_lies_where_mujoco_has_it():
    """Rays of MuJoCo meet the ground where the field says: at the points of the grid, cells longer along x."""
    text = MJCF.replace('<geom name="floor" type="plane" size="5 5 .1" pos="0 0 .1" euler="0 0 10"/>',
                        '<geom name="hill" type="hfield" hfield="hills" pos=".3 -.2 .4"/>')  # fmt: skip
    model = compiled(text)
    model.hfield_data[:] = np.random.default_rng(2).uniform(0, 1, 12)
    field = quiet(spo.from_mujoco, model, contacts="toe").ground
    assert field.heights.shape == (4, 3) and field.cell == (2.0, 2.0)
    data = mujoco.MjData(model)
    data.qpos[2] = 50.0
    mujoco.mj_forward(model, data)
    for i, j in np.ndindex(2, 1):
        i, j = i + 1, j + 1
        x, y = field.origin[0] + 2 * i, field.origin[1] + 2 * j
        start, hit = np.array([x + 1e-9, y + 1e-9, 9.0]), np.zeros(1, np.int32)
        far = mujoco.mj_ray(model, data, start, np.array([0, 0, -1.0]), None, 1, -1, hit)
        np.testing.assert_allclose(9.0 - far, field.heights[i, j] + field.origin[2], atol=1e-6)


URDF = """<robot name="r">
  <mujoco><compiler fusestatic="{fused}" balanceinertia="true" discardvisual="true" strippath="false"/></mujoco>
  <link name="base">{mass}
    <collision><origin xyz=".1 0 .2" rpy=".3 -.4 .5"/><geometry><box size=".2 .4 .6"/></geometry></collision>
    <collision name="pad"><geometry><sphere radius=".1"/></geometry></collision></link>
  <link name="cap">{mass}<contact><lateral_friction value="0.3"/></contact>
    <collision><origin rpy="1.1 .2 0"/><geometry><cylinder radius=".1" length=".5"/></geometry></collision></link>
  <link name="foot">{mass}
    <collision><origin xyz="0 0 -.1" rpy="0 .7 0"/>
      <geometry><mesh filename="{mesh}" scale="1 2 .5"/></geometry></collision></link>
  <joint name="weld" type="fixed"><parent link="base"/><child link="cap"/><origin xyz="0 .3 .1" rpy=".2 0 .9"/></joint>
  <joint name="turn" type="revolute"><parent link="cap"/><child link="foot"/><origin xyz=".2 0 0" rpy="0 0 1.2"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <gazebo reference="foot"><mu1>0.6</mu1></gazebo>
</robot>"""
MASS = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'


def stl(path):
    """Write the wedge as a binary STL of a fan of triangles."""
    points = np.array(WEDGE, dtype="<f4")
    triangles = [(0, i, j) for i in range(1, 6) for j in range(i + 1, 6)]
    body = b"".join(np.zeros(3, "<f4").tobytes() + points[list(t)].tobytes() + b"\0\0" for t in triangles)
    path.write_bytes(bytes(80) + np.uint32(len(triangles)).tobytes() + body)


@pytest.fixture(scope="module")
def urdf(tmp_path_factory):
    file = tmp_path_factory.mktemp("urdf") / "robot.urdf"
    stl(file.parent / "wedge.stl")
    file.write_text(URDF.format(fused="true", mass=MASS, mesh="wedge.stl"))
    return file


def test_shapes_of_a_urdf_are_where_mujoco_has_them(urdf):
    """Origins, axes of cylinders along z, scaled meshes, links that fixed joints join, which MuJoCo merges."""
    model, rng = mujoco.MjModel.from_xml_path(str(urdf)), np.random.default_rng(3)
    assert model.nbody == 2  # base and cap are the world, as in the scene that does not float
    with pytest.warns(UserWarning, match="left out: box 'r/base:0' of body 'r/base', sphere 'pad' of body"):
        scene = spo.load(urdf, contacts="ground", points=64)
    assert [c.label for c in scene.contacts] == ["r/foot"] and scene.contacts[0].friction == 0.6
    for q in rng.uniform(-1, 1, (3, 1)):
        (want,) = geoms(model, q).values()
        assert abs(lowest(scene, q)["r/foot"] - want) < SINGLE
    free = spo.load(urdf, floating=True, contacts="ground", points=64)
    assert {c.label: c.friction for c in free.contacts} == {"r/base:0": 0.8, "pad": 0.8, "r/cap": 0.3, "r/foot": 0.6}
    heights = lowest(free, np.array([0, 0, 0, 0, 0, 0, 1, 0.4]))
    data = mujoco.MjData(model)
    data.qpos[0] = 0.4
    mujoco.mj_kinematics(model, data)
    rows, kinds = data.geom_xmat.reshape(-1, 3, 3)[:, 2], model.geom_type.tolist()
    want = [data.geom_xpos[g, 2] + SUPPORT[kinds[g]](model.geom_size[g], rows[g]) for g in range(3)]
    found = [heights["r/base:0"], heights["pad"], heights["r/cap"]]
    np.testing.assert_allclose(found[:2], want[:2], atol=EXACT)
    assert want[2] - EXACT <= found[2] <= want[2] + 0.1 * (1 - np.cos(np.pi / 32))


def test_a_file_of_a_mesh_that_is_missing_is_named_only_if_needed(tmp_path):
    file = tmp_path / "robot.urdf"
    file.write_text(URDF.format(fused="true", mass=MASS, mesh="package://lost/wedge.stl"))
    spo.load(file)
    with pytest.raises(ValueError, match=r"line 10, <mesh>: there is no file 'package://lost/wedge.stl'.*contacts="):
        spo.load(file, contacts="ground")
    (tmp_path / "wedge.stl").write_bytes(b"solid nothing")
    file.write_text(URDF.format(fused="true", mass=MASS, mesh="wedge.stl"))
    with pytest.raises(ValueError, match=r"line 10, <mesh>: its file (cannot be read|has no vertices)"):
        spo.load(file, contacts="foot")


def newton_model(worlds=2, edit=lambda builder: None, ground=None):
    """A tilted, hinged pair of bodies with a shape of each kind on them; bodies and shapes turned."""
    builder = newton.ModelBuilder()
    rng = np.random.default_rng(4)

    def pose():
        return wp.transform(rng.uniform(-0.3, 0.3, 3), wp.normalize(wp.quat(*rng.normal(size=4))))

    trunk, arm = (builder.add_link(mass=1.0, label=name) for name in ("trunk", "arm"))
    builder.add_articulation([
        builder.add_joint_free(trunk),
        builder.add_joint_revolute(trunk, arm, parent_xform=pose(), child_xform=pose(), axis=(0.0, 0.6, 0.8)),
    ])  # fmt: skip
    cfg = newton.ModelBuilder.ShapeConfig(ke=4e3, kd=30.0, mu=0.5, margin=0.01)
    for body in (trunk, arm):
        name = builder.body_label[body]
        builder.add_shape_sphere(body, xform=pose(), radius=0.1, cfg=cfg, label=f"{name} sphere")
        builder.add_shape_capsule(body, xform=pose(), radius=0.05, half_height=0.2, cfg=cfg, label=f"{name} capsule")
        builder.add_shape_box(body, xform=pose(), hx=0.1, hy=0.2, hz=0.3, cfg=cfg, label=f"{name} box")
        builder.add_shape_cylinder(body, xform=pose(), radius=0.1, half_height=0.2, cfg=cfg, label=f"{name} cylinder")
        builder.add_shape_cone(body, xform=pose(), radius=0.1, half_height=0.2, cfg=cfg, label=f"{name} cone")
        mesh = newton.Mesh(np.array(WEDGE, np.float32), np.array([0, 1, 2, 0, 2, 3, 0, 1, 4, 2, 3, 5], np.int32))
        builder.add_shape_mesh(body, xform=pose(), mesh=mesh, scale=(1, 2, 3), cfg=cfg, label=f"{name} mesh")
    edit(builder)
    every = newton.ModelBuilder()
    every.replicate(builder, worlds)
    every.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(ke=2e3, kd=10.0, mu=0.9)) if ground is None else ground(
        every
    )
    return every.finalize(device="cpu")


SUPPORTS = {  # lowest height of Newton's shapes of scale s about their centre; r: heights of their axes
    "sphere": lambda s, r: -s[0],
    "capsule": lambda s, r: -s[0] - s[1] * abs(r[2]),
    "box": lambda s, r: -np.abs(r) @ s,
    "cylinder": lambda s, r: -s[0] * np.hypot(r[0], r[1]) - s[1] * abs(r[2]),
    "cone": lambda s, r: min(s[1] * r[2], -s[1] * r[2] - s[0] * np.hypot(r[0], r[1])),
    "mesh": lambda s, r: (np.array(WEDGE) * s @ r).min(),
}


def test_shapes_of_a_newton_model_are_where_newton_has_them():
    """Against support functions of Newton's shapes in Newton's own body poses."""
    model = newton_model()
    scene = spo.from_newton(model, contacts="ground", points=64)
    state, rng = model.state(), np.random.default_rng(5)
    q = rng.uniform(-1, 1, scene.coord_count)
    q[3:7] /= np.linalg.norm(q[3:7])
    state.joint_q.assign(np.tile(q, 2))
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    found, where = lowest(scene, q), [wp.transform(*pose) for pose in state.body_q.numpy()[:2]]
    for i in range(12):
        at = wp.transform_multiply(where[model.shape_body.numpy()[i]], wp.transform(*model.shape_transform.numpy()[i]))
        x, y, z = (np.array(wp.quat_rotate(at.q, wp.vec3(*axis)))[2] for axis in np.eye(3))
        kind = model.shape_label[i].rpartition(" ")[2]
        low = SUPPORTS[kind](model.shape_scale.numpy()[i], np.array([x, y, z]))
        rim = 0.1 * (1 - np.cos(np.pi / 32)) if kind in ("cylinder", "cone") else 0.0
        label = next(label for label in found if model.shape_label[i].endswith(label))
        want = at.p[2] + low - 0.01
        assert want - 1e-6 <= found[label] <= want + rim + 1e-6, label


def test_a_newton_model_without_a_plane_has_no_floor():
    model = newton_model(ground=lambda builder: None)
    with pytest.warns(
        UserWarning, match=r"from_newton: left out: all contacts with a ground, because there is no plane"
    ):
        assert not spo.from_newton(model, contacts="ground").contacts
    assert spo.from_newton(model, contacts="ground", ground=spo.Plane()).contacts


def test_materials_of_a_newton_model_are_means_with_its_ground():
    """ke, kd, mu one to one; worlds may differ."""
    model = newton_model()
    mu = model.shape_material_mu.numpy()
    mu[12] = 0.1  # the first shape of world 1
    model.shape_material_mu.assign(mu)
    scene = spo.from_newton(model, contacts="ground")
    assert scene.values["contact_stiffness"].tolist() == [[3e3] * len(scene.contact_points)]
    assert scene.values["contact_damping"][0, 0] == 20.0
    np.testing.assert_allclose(scene.values["contact_friction"][:, :2], [[0.7, 0.7], [0.5, 0.7]], atol=1e-7)
    alone = spo.from_newton(model, contacts="ground", ground=spo.Plane())
    np.testing.assert_allclose(alone.values["contact_friction"][:, :2], [[0.5, 0.5], [0.1, 0.5]], atol=1e-7)
    assert alone.values["contact_stiffness"][0, 0] == 4e3


def test_what_newton_lets_pass_has_no_contact():
    """Groups, filters and flags of shapes count."""

    def edit(builder):
        builder.shape_collision_group[0] = 0
        builder.shape_flags[1] &= ~int(newton.ShapeFlags.COLLIDE_SHAPES)
        builder.shape_collision_group[2] = 5

    labels = [c.label for c in spo.from_newton(newton_model(1, edit), contacts="trunk").contacts]
    assert sorted({label.rpartition(" ")[2] for label in labels}) == ["cone", "cylinder", "mesh"]


@pytest.mark.parametrize("ground, words", [
    (lambda b: b.add_shape_plane(width=3.0, length=3.0), "left out: finite plane"),
    (lambda b: b.add_shape_box(-1, hx=1.0, hy=1.0, hz=1.0, label="block"), "left out: box 'block' of the world"),
])  # fmt: skip
def test_what_stands_still_and_is_no_ground_is_left_out_by_name(ground, words):
    with pytest.warns(UserWarning, match=words):
        spo.from_newton(newton_model(1, ground=ground), contacts="ground")


def test_a_turned_height_field_is_refused():
    field = newton.Heightfield(np.random.default_rng(6).uniform(size=(4, 5)), 4, 5, hx=2.0, hy=1.5)

    def on(*pose):
        add = lambda b: b.add_shape_heightfield(heightfield=field, xform=wp.transform(*pose))  # noqa: E731
        return spo.from_newton(newton_model(1, ground=add), contacts="ground").ground

    with pytest.raises(spo.UnsupportedError, match=r"height field .* whose axes are turned"):
        on((0, 0, 0), wp.quat(0, 0, 0.6, 0.8))
    ground = on((1, 2, 3), wp.quat_identity())
    assert ground.cell == (1.0, 1.0) and ground.origin == (-1.0, 0.5, 3.0)
    np.testing.assert_allclose(ground.heights, (field.min_z + field.data * (field.max_z - field.min_z)).T, atol=1e-6)


def test_worlds_with_different_shapes_are_refused():
    builder = newton.ModelBuilder()
    for radius in (0.1, 0.2):
        one = newton.ModelBuilder()
        ball = one.add_link(mass=1.0)
        one.add_articulation([one.add_joint_free(ball)])
        one.add_shape_sphere(ball, radius=radius)
        builder.add_world(one)
    model = builder.finalize(device="cpu")
    assert not spo.from_newton(model).contacts
    with pytest.raises(spo.UnsupportedError, match=r"world 1 differs in shape_scale"):
        spo.from_newton(model, contacts="ground")


def test_reduced_hulls_keep_what_reaches_farthest():
    """Corners before the rest; the rest is nearer and nearer; a box of many points is its corners."""
    rng = np.random.default_rng(7)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-2, 2) for z in (-3, 3.0)])
    cloud = np.concatenate([rng.uniform(-0.9, 0.9, (200, 3)) * [1, 2, 3], corners])
    assert farthest_points(cloud, 8).tolist() == list(range(200, 208)) and farthest_points(cloud, 50).tolist() == list(
        range(200, 208)
    )
    ball = rng.normal(size=(500, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    missing = [
        ((ball @ directions.T).max(0) - (ball[farthest_points(ball, n)] @ directions.T).max(0)).max()
        for n in (4, 8, 16, 64)
    ]
    assert missing == sorted(missing, reverse=True) and missing[-1] < 0.06
