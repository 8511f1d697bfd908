"""Pairs of bodies that touch each other, from files and models: which, against MuJoCo and Newton, and with what values.

MuJoCo's own collision driver says which geoms touch: with spheres in the place of all geoms and huge margins, every
pair that it does not filter is a contact.
"""

import warnings
from pathlib import Path

import mujoco
import newton
import numpy as np
import pytest

import warp_spo as spo
from warp_spo.mujoco import Coordinates
from warp_spo.mujoco.geom_pairs import geom_pairs
from warp_spo.mujoco.mjcf import compiled
from warp_spo.mujoco.source import Source
from warp_spo.newton import shipped
from warp_spo.newton.model_contacts import ModelShapes
from warp_spo.newton.pairs import select_pairs
from warp_spo.newton.worlds import WorldRows
from warp_spo.scene.collision_shapes import moving_bodies
from warp_spo.scene.extreme_points import spread_directions
from warp_spo.scene.hulls import _remembered_hull
from warp_spo.scene.shape_pairs import PairSelection

EVERYWHERE = 1e3  # a margin, m
BALL = '<geom name="{0}" size=".1" contype="{1}" conaffinity="{2}"/>'


def quiet(call, *given, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return call(*given, **options)


def numbers(selection):
    """Return the numbers of the shapes of all pairs that a selection finds."""
    return {frozenset(shape.index for shape in pair) for pair in selection.candidates()}


# -- MJCF --------------------------------------------------------------------------------------------------------------
def pairs_of_mujoco(model):
    """Return the pairs of geoms of two rigid pieces that MuJoCo's driver makes contacts of, planes and fields apart."""
    ground = model.geom_type <= int(mujoco.mjtGeom.mjGEOM_HFIELD)
    model.geom_type[~ground] = int(mujoco.mjtGeom.mjGEOM_SPHERE)
    for margins in (model.geom_margin, model.pair_margin, model.body_margin):
        margins[:] = EVERYWHERE
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pieces = model.body_weldid[model.geom_bodyid]
    rows = {frozenset(map(int, pair)) for pair in data.contact.geom if not ground[pair].any()}
    return {pair for pair in rows if len({int(pieces[geom]) for geom in pair}) == 2}  # explicit pairs of one piece


def balls(rng):
    """Return random trees of balls: masks, exclusions, pairs, rigid and still pieces, a mocap body, world geoms."""
    count, text, close = rng.integers(2, 6), BALL.format("w", 1, 1), 0
    for i in range(count):
        roots = ['mocap="true"', ""] if close == 0 else [""]
        root = rng.choice(roots, p=[0.2, 0.8] if close == 0 else [1.0])
        joint = "" if root else rng.choice(["", '<joint axis="0 0 1"/>', '<joint axis="0 0 1"/><joint axis="1 0 0"/>'])
        ball = BALL.format(f"g{i}", *rng.choice([0, 0, 1, 2, 3], 2))
        text += f'<body name="b{i}" {root}><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>{joint}{ball}'
        ends = rng.integers(0, 2)
        text, close = text + "</body>" * ends, close + 1 - ends
    text += "</body>" * close
    names = [f"{i} {j}".split() for i in range(count) for j in range(i)]
    excluded = "".join(f'<exclude body1="b{i}" body2="b{j}"/>' for i, j in names if rng.random() < 0.3)
    pairs = "".join(f'<pair geom1="g{i}" geom2="g{j}"/>' for i, j in names if rng.random() < 0.1)
    flag = rng.choice(["enable", "disable"], p=[0.7, 0.3])
    return (
        f'<mujoco><option><flag filterparent="{flag}"/></option><worldbody>{text}</worldbody>'
        f"<contact>{excluded}{pairs}</contact></mujoco>"
    )


def test_pairs_are_those_of_mujoco():
    """In 200 random trees; a pair of which nothing moves in the scene, such as two mocap bodies, is none."""
    rng, counts = np.random.default_rng(0), []
    for _ in range(200):
        model = mujoco.MjModel.from_xml_string(balls(rng))
        scene = quiet(spo.from_mujoco, model)
        moves = np.concatenate([[False], moving_bodies(scene)[: model.nbody - 1]])[model.geom_bodyid]
        found = numbers(geom_pairs(Source(model), scene))
        wanted = {pair for pair in pairs_of_mujoco(model) if moves[list(pair)].any()}
        assert found == wanted
        counts.append(len(wanted))
    assert counts.count(0) < 100 and max(counts) > 8


GRIPPER = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
 <geom name="table" type="box" size=".2 .2 .02" pos="0 0 .02"/>
 <body name="hand" pos="0 0 .12"><joint name="lift" type="slide" axis="0 0 1"/><geom name="palm" type="box"
  size=".08 .02 .01" pos="0 0 .05"/>
  <body name="left" pos="-.05 0 0"><joint name="left" type="slide" axis="1 0 0"/>
   <geom name="left" type="box" size=".01 .02 .03" mass=".1" friction="1.2"/></body>
  <body name="right" pos=".05 0 0"><joint name="right" type="slide" axis="-1 0 0"/>
   <geom name="right" type="box" size=".01 .02 .03" mass=".1" friction=".9" priority="1"/></body></body>
 <body name="cube" pos="0 0 .07"><freejoint/><geom name="cube" type="box" size=".03 .03 .03" mass=".2"
  friction=".7"/></body></worldbody></mujoco>"""
FILES = {
    "ant": (shipped("ant"), 44),
    "humanoid": (shipped("humanoid"), 142),
    "gripper": (GRIPPER, 8),  # table, palm, fingers and cube, but the palm with its fingers
}


@pytest.mark.parametrize("name", FILES)
def test_pairs_of_files_are_those_of_mujoco(name):
    text, count = FILES[name]
    model = compiled(text)[0] if isinstance(text, Path) else mujoco.MjModel.from_xml_string(text)
    found = numbers(geom_pairs(Source(model), quiet(spo.from_mujoco, model)))
    assert found == pairs_of_mujoco(model) and len(found) == count


def test_a_base_that_the_caller_frees_has_the_pairs_of_a_file_that_frees_it(tmp_path):
    """And one that is fixed: its child then touches what stands still, as the child of the world does in MuJoCo."""
    text = """<mujoco><worldbody><geom name="wall" size=".1"/><body name="base">{}<geom name="base" size=".1"/>
     <body name="arm"><joint name="turn"/><geom name="arm" size=".1"/></body></body></worldbody></mujoco>"""
    own = {free: text.format("<freejoint/>" if free else "") for free in (True, False)}
    for free in (True, False):
        file = tmp_path / f"{free}.xml"
        file.write_text(own[not free])
        pairs = spo.load(file, floating=free, contacts=None, pairs="all").contacts
        wanted = pairs_of_mujoco(mujoco.MjModel.from_xml_string(own[free]))
        assert len(pairs) == len(wanted) == 2


def test_values_of_pairs_are_those_of_mujocos_contacts():
    """Friction by masks, priority, one dimension and <pair>; margins of both, or of the pair."""
    rng, names = np.random.default_rng(1), []
    bodies = ""
    for i in range(8):
        name, mu, margin, priority = f"g{i}", rng.uniform(0.1, 1), rng.uniform(0, 1e-2), rng.integers(0, 2)
        bodies += f"""<body><freejoint/><geom name="{name}" size="{0.1 + 0.01 * i}" friction="{mu} .01 .001"
         condim="{rng.choice([1, 3])}" margin="{margin}" priority="{priority}" pos="{0.01 * i} 0 0"/></body>"""
        names.append(name)
    pairs = '<pair geom1="g0" geom2="g1" friction=".3 .3 .1 .1 .1" margin=".002"/><pair geom1="g2" geom2="g5"/>'
    text = f"<mujoco><worldbody>{bodies}</worldbody><contact>{pairs}</contact></mujoco>"
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = {c.label: c for c in quiet(spo.from_mujoco, model, pairs="all").contacts}
    assert len(found) == data.ncon == 28
    for contact in data.contact:
        a, b = sorted(map(int, contact.geom))
        own = found[f"g{a} with g{b}"]
        assert own.friction == (contact.friction[0] if contact.dim > 1 else 0.0)
        grown = own.shape.radius + own.other.shape.radius - model.geom_size[[a, b], 0].sum()
        np.testing.assert_allclose(grown, contact.includemargin, atol=1e-15)


# -- URDF --------------------------------------------------------------------------------------------------------------
def link(name, mass=1.0):
    return f"""<link name="{name}"><inertial><mass value="{mass}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
     iyz="0"/></inertial><collision><geometry><sphere radius="0.1"/></geometry></collision></link>"""


def random_urdf(rng, fixed):
    """Return a URDF of balls, the parent of each link but the first, and whether its joint moves."""
    parents = [int(rng.integers(0, i)) for i in range(1, rng.integers(4, 8))]
    moves = [bool(rng.random() >= fixed) for _ in parents]
    text = "".join(
        f"""<joint name="j{i}" type="{"continuous" if moving else "fixed"}"><parent link="l{parent}"/>
         <child link="l{i}"/><axis xyz="0 0 1"/></joint>"""
        for i, (parent, moving) in enumerate(zip(parents, moves, strict=True), 1)
    )
    return f'<robot name="r">{"".join(link(f"l{i}") for i in range(len(parents) + 1))}{text}</robot>', parents, moves


def joints_between(parents, moves):
    """Return how many joints that move lie between every two links [link, link]."""
    count = np.full((len(parents) + 1,) * 2, 99)
    np.fill_diagonal(count, 0)
    for i, (parent, moving) in enumerate(zip(parents, moves, strict=True), 1):
        count[i, parent] = count[parent, i] = int(moving)
    for middle in range(len(count)):  # shortest ways, by Floyd and Warshall
        count = np.minimum(count, count[:, [middle]] + count[[middle]])
    return count


def pairs_of_urdf(file, floating, monkeypatch):
    """Return the names of the links of all pairs that a file lets touch."""
    seen = []
    monkeypatch.setattr(PairSelection, "missed", lambda self: seen.append(self) or [])
    quiet(spo.load, file, floating=floating, contacts="*", ground=spo.Plane())
    names = [shape.label for shape in seen[0].shapes]
    return {frozenset(names[number] for number in pair) for pair in numbers(seen[0])}


@pytest.mark.parametrize("floating", [True, False])
def test_links_of_a_urdf_touch_where_two_joints_are_between_them(floating, tmp_path, monkeypatch):
    """Links that a fixed joint connects are one; where all joints move the pairs are Newton's."""
    rng, file, total = np.random.default_rng(2), tmp_path / "robot.urdf", 0
    for case in range(24):
        text, parents, moves = random_urdf(rng, fixed=0.3 if case % 2 else 0.0)
        file.write_text(text)
        found = pairs_of_urdf(file, floating, monkeypatch)
        assert found == {frozenset((f"r/l{i}", f"r/l{j}")) for i, j in np.argwhere(joints_between(parents, moves) > 1)}
        total += len(found)
        if all(moves):
            builder = newton.ModelBuilder()
            builder.add_urdf(str(file), floating=floating)
            model = quiet(builder.finalize, device="cpu")
            bodies = model.shape_body.numpy()[model.shape_contact_pairs.numpy()]
            assert found == {frozenset(model.body_label[body] for body in pair) for pair in bodies}
    assert total > 100


# -- Newton ------------------------------------------------------------------------------------------------------------
def random_model(rng, worlds=2):
    """Return a model of two worlds with joints, groups, filters, fixed bodies, static and global shapes."""
    one, config = newton.ModelBuilder(), newton.ModelBuilder.ShapeConfig
    for tree in range(3):
        above = -1
        joints = []
        for number in range(rng.integers(1, 4)):
            body = one.add_link()
            group = int(rng.choice([-2, -1, 1, 2]))
            one.add_shape_sphere(body, radius=0.1, cfg=config(collision_group=group), label=f"s{tree}{number}")
            if above < 0:
                joints.append(one.add_joint_free(body))
            else:
                filters = bool(rng.integers(0, 2))
                joints.append(one.add_joint_revolute(above, body, axis=(0, 0, 1), collision_filter_parent=filters))
            above = body
        one.add_articulation(joints)
    cfg = config(collision_group=int(rng.choice([-1, 1])))
    one.add_shape_box(-1, hx=0.1, hy=0.1, hz=0.1, cfg=cfg, label="post")
    one.add_shape_collision_filter_pair(0, int(rng.integers(1, one.shape_count)))
    many = newton.ModelBuilder()
    many.replicate(one, worlds)
    many.add_shape_sphere(-1, radius=0.2, label="global")
    return quiet(many.finalize, device="cpu")


def test_pairs_of_a_model_are_those_of_newton():
    """Its list of pairs of the first world and of global shapes, of which one moves."""
    rng, total = np.random.default_rng(3), 0
    for _ in range(20):
        model = random_model(rng)
        scene = quiet(spo.from_newton, model)
        worlds = WorldRows(model)
        found = numbers(select_pairs("from_newton", ModelShapes(model, worlds), scene, takes_still=True))
        body, world = model.shape_body.numpy(), model.shape_world.numpy()
        pairs = model.shape_contact_pairs.numpy()
        own = [p for p in pairs if (world[p] <= 0).all() and (world[p] == 0).any() and (body[p] >= 0).any()]
        assert found == {frozenset(map(int, pair)) for pair in own}
        total += len(found)
    assert total > 100


# -- scenes ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("options", [dict(contacts=True), dict(contacts="ground", pairs="all")])
def test_contacts_true_are_those_of_the_file(options, tmp_path, recwarn):
    """Of bodies and with what stands still, which is then not left out; forces on what moves; names choose some."""
    file = tmp_path / "gripper.xml"
    file.write_text(GRIPPER)
    scene = spo.load(file, **options)
    labels = {c.label: c.friction for c in scene.contacts if c.other is not None}
    assert labels == {
        "palm with table": 1.0, "left with table": 1.2, "right with table": 0.9, "cube with table": 1.0,
        "palm with cube": 1.0, "left with cube": 1.2, "right with cube": 0.9, "left with right": 0.9,
    }  # fmt: skip
    assert len(scene.contact_points) == 16 and len(scene.contact_pairs) == 8 and not recwarn.list
    some = spo.load(file, contacts="ground", pairs=[("cube", "left"), ("right", "cube"), ("cube", "table")])
    assert [c.label for c in some.contacts[-3:]] == ["cube with left", "right with cube", "cube with table"]
    assert some.ground.height == 0.0 and not recwarn.list
    alone = spo.load(file, pairs="all")
    assert len(alone.contact_pairs) == 8 and not alone.contact_points


TEXT = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"{0}/>
 <body name="hand"><freejoint/><geom name="palm" size=".1"{0}/></body>
 <body name="cube"><freejoint/><geom name="side" type="box" size=".1 .1 .1"{0}/></body>
 </worldbody><contact>{1}</contact></mujoco>"""
OFF = ' contype="0" conaffinity="0"'
PAIRS = '<pair geom1="palm" geom2="floor"/><pair geom1="side" geom2="palm"/>'


@pytest.mark.parametrize("off, pairs", [("", ""), (OFF, PAIRS)])
def test_a_warning_names_what_is_left_out(off, pairs):
    model = mujoco.MjModel.from_xml_string(TEXT.format(off, pairs))
    words = (
        r"left out: contacts between bodies: 1 pair\(s\) of shapes, such as sphere 'palm' of body 'hand' with box "
        r"'side' of body 'cube' \(pairs='all' takes them; contacts='ground' or pairs=\[\] says that there are none\)"
    )
    with pytest.warns(UserWarning, match=words):
        scene = spo.from_mujoco(model, contacts="*")
    assert scene.contacts and not scene.contact_pairs
    with pytest.warns(UserWarning, match=r"left out: contacts of 3 geom\(s\), geom 'floor' among them"):
        spo.from_mujoco(model)


@pytest.mark.parametrize("options", [dict(contacts="ground"), dict(contacts="*", pairs=[])])
def test_contacts_with_the_ground_alone_warn_of_no_bodies(options, recwarn):
    model = mujoco.MjModel.from_xml_string(TEXT.format("", ""))
    assert len(spo.from_mujoco(model, **options).contacts) == 2
    assert not recwarn.list


def test_no_warning_where_bodies_only_touch_the_ground(recwarn):
    text = TEXT.format("", "").replace('name="palm" size=".1"', 'name="palm" size=".1" contype="2" conaffinity="1"')
    text = text.replace('name="side"', 'name="side" contype="4" conaffinity="1"')
    for contacts in (True, "*"):
        assert len(spo.from_mujoco(mujoco.MjModel.from_xml_string(text), contacts=contacts).contacts) == 2
    assert not recwarn.list


def test_what_pairs_do_not_take_is_said():
    """Shapes without a narrow phase of steps, friction against turning, softness, contacts that the file disables."""
    turning = TEXT.replace('name="palm" size=".1"', 'name="palm" size=".1" condim="4" solref=".1 1"')
    points = " ".join(f"{x:.4f}" for x in np.ravel(0.1 * spread_directions(100)))
    stone = turning.replace(
        "</worldbody>", '<body><freejoint/><geom name="stone" type="mesh" mesh="stone"/></body></worldbody>'
    ).replace("<worldbody>", f'<asset><mesh name="stone" vertex="{points}"/></asset><worldbody>')
    model = mujoco.MjModel.from_xml_string(stone.format("", ""))
    with pytest.warns(UserWarning) as found:
        scene = spo.from_mujoco(model, pairs="all")
    (words,) = {str(one.message) for one in found}
    assert "torsional friction, solref of 1 pair(s) of shapes, such as sphere 'palm' of body 'hand' with box" in words
    assert "contacts of 2 pair(s) of shapes, such as sphere 'palm' of body 'hand' with hull 'stone'" in words
    assert len(scene.contact_pairs) == 1
    disabled = stone.replace("<worldbody>", '<option><flag contact="disable"/></option><worldbody>')
    model = mujoco.MjModel.from_xml_string(disabled.format("", ""))
    with pytest.warns(UserWarning, match="all contacts, which its options disable"):
        assert not spo.from_mujoco(model, contacts="ground", pairs="all").contacts
    assert len(quiet(spo.from_mujoco, model, pairs=[("palm", "side")]).contact_pairs) == 1


def crowd(count, condim, shape='size=".1"'):
    """Return MuJoCo's model of free bodies over a floor."""
    bodies = "".join(
        f'<body name="b{i}"><freejoint/><geom name="g{i}" {shape} condim="{condim}"/></body>' for i in range(count)
    )
    text = f'<mujoco><worldbody><geom type="plane" size="1 1 1"/>{bodies}</worldbody></mujoco>'
    return mujoco.MjModel.from_xml_string(text)


def test_pairs_that_no_step_takes_are_left_out_of_true_and_refused_of_all():
    """Of more dofs than joint space takes; others are taken, where there are actuators, too."""
    model = crowd(44, 3)
    why = "steps of a scene with 264 dofs do not solve such pairs in joint space"
    with pytest.warns(
        UserWarning, match=rf"946 pair\(s\) of shapes, such as .*, because {why} \(pairs=\[\.\.\.\] takes"
    ):
        scene = spo.from_mujoco(model, contacts=True)
    assert not scene.contact_pairs and len(scene.contact_points) == 44
    with pytest.raises(spo.UnsupportedError, match=rf"contact of 946 pairs of shapes \({why}\)"):
        quiet(spo.from_mujoco, model, contacts="ground", pairs="all")
    cans = crowd(44, 3, 'type="cylinder" size=".1 .1"')
    with pytest.raises(spo.UnsupportedError, match=rf"contact of 1 pairs of shapes \({why}\)"):
        quiet(spo.from_mujoco, cans, contacts="ground", pairs=[("g0", "g1")])
    scene = spo.from_mujoco(crowd(9, 3), contacts=True)
    assert (len(scene.contact_pairs), len(scene.contact_points)) == (36, 9)
    scene = quiet(spo.load, shipped("ant"), contacts=True)
    assert (len(scene.contact_pairs), len(scene.contact_points), len(scene.actuators)) == (44, 25, 8)


@pytest.mark.parametrize("count, shape", [(9, 'size=".1"'), (2, 'type="cylinder" size=".1 .1"')])
@pytest.mark.parametrize("asked", [{}, {"pairs": "all"}, {"pairs": [("g0", "g1")]}])
def test_friction_against_turning_gives_way_to_pairs(count, shape, asked):
    """On the ground, where no step takes both; a warning says so. Few spheres keep it."""
    listed = "pairs" in asked and asked["pairs"] != "all"
    keeps = listed and count == 9  # one pair of spheres
    model, wanted = crowd(count, 4, shape), 1 if listed else count * (count - 1) // 2
    with pytest.warns(UserWarning) as found:
        scene = spo.from_mujoco(model, contacts=True, **asked)
    words = "".join(str(each.message) for each in found)
    assert len(scene.contact_pairs) == wanted and len(scene.contact_points) >= count
    assert ("torsional friction of the ground, with which no step takes these pairs" in words) != keeps
    assert any(one.torsional_friction for one in scene.contacts) == keeps


def test_contacts_true_of_a_model_and_a_urdf_have_their_pairs(tmp_path):
    """Materials of a pair are means, which may differ between worlds; a ball on a post of a URDF touches nothing."""
    one = newton.ModelBuilder()
    config = newton.ModelBuilder.ShapeConfig
    for mu in (0.2, 0.6):
        one.add_shape_sphere(one.add_body(), radius=0.1, cfg=config(mu=mu, ke=1e3 * mu, kd=5.0))
    one.add_shape_box(-1, hx=0.1, hy=0.1, hz=0.1, cfg=config(mu=1.0, ke=3e3, kd=7.0), label="post")
    many = newton.ModelBuilder()
    many.replicate(one, 2)
    many.add_ground_plane()
    model = many.finalize(device="cpu")
    mu = model.shape_material_mu.numpy()
    mu[4] = 0.8  # the second ball of the second world
    model.shape_material_mu.assign(mu)
    scene = spo.from_newton(model, contacts=True)
    assert (len(scene.contact_points), len(scene.contact_pairs)) == (2, 3)
    assert sorted((pair.body, pair.other) for pair in scene.contact_pairs) == [(0, -1), (0, 1), (1, -1)]
    rows = {(pair.body, pair.other): 2 + i for i, pair in enumerate(scene.contact_pairs)}
    friction = scene.values["contact_friction"]
    np.testing.assert_allclose(friction[:, rows[0, 1]], [0.4, 0.5], rtol=1e-6)
    np.testing.assert_allclose(scene.values["contact_stiffness"][0, rows[1, -1]], 1.8e3, rtol=1e-6)
    np.testing.assert_allclose(scene.values["contact_damping"][0, rows[1, -1]], 6.0, rtol=1e-6)
    file = tmp_path / "robot.urdf"
    joints = "".join(
        f"""<joint name="j{i}" type="continuous"><origin xyz="0.3 0 0"/><parent link="l{i - 1}"/><child link="l{i}"/>
        <axis xyz="0 0 1"/></joint>"""
        for i in (1, 2)
    )
    file.write_text(f'<robot name="r">{"".join(link(f"l{i}") for i in range(3))}{joints}</robot>')
    assert [c.label for c in spo.load(file, floating=True, contacts=True).contacts[-1:]] == ["r/l0 with r/l2"]


def test_hulls_whose_faces_are_too_large_together_are_left_out():
    """Of 12 and 12 corners; one of them touches a box. A hull of many pairs is computed once."""
    turn = np.linspace(0, 2 * np.pi, 13)[:-1]
    points = [f"{np.cos(a)} {np.sin(a)} {z}" for z in (0, 1) for a in turn]
    asset = f'<asset><mesh name="drum" vertex="{" ".join(points)}"/></asset>'
    drums = '<body><freejoint/><geom name="{}" type="mesh" mesh="drum"/></body>'
    box = '<body><freejoint/><geom name="box" type="box" size="1 1 1"/></body>'
    bodies = drums.format("a") + drums.format("b") + box
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{asset}<worldbody>{bodies}</worldbody></mujoco>")
    with pytest.warns(UserWarning, match="contacts of 1 pair.* such as hull 'a' of .* with hull 'b' of"):
        scene = spo.from_mujoco(model, pairs="all")
    assert {contact.label for contact in scene.contacts} == {"a with box", "b with box"}
    before = _remembered_hull.cache_info().misses
    quiet(spo.from_mujoco, model, pairs="all")
    assert _remembered_hull.cache_info().misses == before


@pytest.mark.parametrize("pairs, error, words", [
    ([("torso_geom", "nobody")], ValueError, r"nv_ant.xml': pairs holds 'nobody', which is no collision shape"),
    ("some", TypeError, r"pairs is 'some'; expected 'all', or a list of pairs of names"),
])  # fmt: skip
def test_pairs_that_cannot_be_are_errors(pairs, error, words):
    with pytest.raises(error, match=words):
        quiet(spo.load, shipped("ant"), contacts="ground", pairs=pairs)


STAGE = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Z"
)
def PhysicsScene "s" {{}}
{}
def Cube "table" ( prepend apiSchemas = ["PhysicsCollisionAPI"] ) {{
  double size = 1
}}
"""
MARBLE = """def Sphere "b{0}" ( prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI",
  "PhysicsFilteredPairsAPI"] ) {{
  double radius = 0.1
  float physics:mass = 1
  {1}
}}
"""


def test_filtered_pairs_of_usd_do_not_touch(tmp_path):
    file = tmp_path / "marbles.usda"
    file.write_text(STAGE.format(MARBLE.format(0, "rel physics:filteredPairs = </b1>") + MARBLE.format(1, "")))
    scene = spo.load(file, contacts=True, ground=spo.Plane(-1.0))
    assert {contact.label for contact in scene.contacts} == {"/b0", "/b1", "/b0 with /table", "/b1 with /table"}


# -- steps -------------------------------------------------------------------------------------------------------------
STACK = f"""<mujoco><worldbody><geom type="plane" size="1 1 1"/>{
    "".join(
        f'<body pos="{0.002 * i} 0 {0.05 + 0.1 * i}"><freejoint/><geom type="box" size=".05 .05 .05" mass="1"/></body>'
        for i in range(3)
    )
}</worldbody></mujoco>"""
FINGERS = "".join(
    f'''<body pos="{0.05 * x} {0.05 * y} .02"><joint axis="{-y} {x} 0" range="-30 90" damping=".01" stiffness=".2"
     armature=".0005"/><geom type="capsule" fromto="0 0 0 0 0 .04" size=".008" mass=".03"/>
     <body pos="0 0 .05"><joint axis="{-y} {x} 0" range="-30 90" damping=".01" stiffness=".2" armature=".0005"/>
      <geom type="capsule" fromto="0 0 0 0 0 .03" size=".008" mass=".02"/></body></body>'''
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))
)
HAND = f"""<mujoco><worldbody><body name="palm" pos="0 0 .3"><geom name="palm" type="box" size=".05 .05 .01"/>{FINGERS}
 </body><body name="cube" pos="0 0 .341"><freejoint/><geom name="cube" type="box" size=".03 .03 .03" mass=".1"/></body>
 </worldbody></mujoco>"""
G = 9.81


def run(text, tau, steps):
    """Return scene, places and the force of each pair by name after steps of 5 ms from a file's own first state."""
    model = mujoco.MjModel.from_xml_string(text)
    scene = quiet(spo.from_mujoco, model, contacts=True)
    dyn = spo.Dynamics(scene, worlds=1, dtype="float64", device="cpu")
    q = Coordinates(scene, model, worlds=1, dtype="float64", device="cpu").q(model.qpos0[None])
    qd = np.zeros((1, scene.dof_count))
    report = dyn.step_report("contact_f", like=q)
    for step in range(steps):
        q, qd = dyn.step(q, qd, tau(step)[None], dt=5e-3, report=report)
    forces = report.contact_f[0, len(scene.contact_points) :]
    names = [scene.contacts[pair.contact].label for pair in scene.contact_pairs]
    return scene, q[0], dict(zip(names, forces, strict=True))


@pytest.mark.slow
def test_a_gripper_of_a_file_lifts_its_cube():
    """With 20 N at each finger, by what the hand is pushed up: the cube goes with it."""
    weight = (model := mujoco.MjModel.from_xml_string(GRIPPER)).body_subtreemass[model.body("hand").id] * G
    lift = lambda step: np.concatenate([[weight + (2.0 + 0.2 * G if step > 40 else 0.0), 20.0, 20.0], np.zeros(6)])  # noqa: E731
    _, q, force = run(GRIPPER, lift, 120)
    assert q[0] > 0.05 and abs(q[5] - 0.07 - q[0]) < 1e-3
    assert abs(force["left with cube"][0]) > 15.0 and not np.any(force["cube with table"])


@pytest.mark.slow
def test_a_cube_lies_in_a_hand_of_a_file():
    scene, q, force = run(HAND, lambda step: np.zeros(14), 100)
    assert len(scene.contact_pairs) == 41
    np.testing.assert_allclose(force["cube with palm"], [0, 0, 0.1 * G], atol=1e-3)
    np.testing.assert_allclose(q[-7:-4], [0, 0, 0.34], atol=2e-4)


@pytest.mark.slow
def test_boxes_of_a_file_stand_on_each_other():
    scene, q, _ = run(STACK, lambda step: np.zeros(18), 200)
    assert len(scene.contact_pairs) == 3
    np.testing.assert_allclose(q[2::7], [0.05, 0.15, 0.25], atol=3e-4)
    np.testing.assert_allclose(q[0::7], [0.0, 0.002, 0.004], atol=1e-4)


OVERLAPPING = """<mujoco><asset><mesh name="tip" vertex="-1 -1 0 1 -1 0 1 1 0 -1 1 0 0 0 1" scale=".1 .1 .1"/></asset>
 <worldbody><geom name="post" type="capsule" fromto="0 0 0 0 0 1" size=".05"/>
 <body name="a" pos=".5 0 .4"><joint axis="0 1 0"/><geom name="a" type="box" size=".1 .1 .1"/>
  <body name="b" pos=".3 0 0"><joint axis="0 1 0"/><geom name="b" type="sphere" size=".05"/>
   <body name="c" pos="{gap} 0 0"><joint axis="0 1 0"/><geom name="c" {shape}/></body></body></body>
 <body name="free"><freejoint/><geom size=".3"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("shape, gap, depth", [
    ('type="box" size=".1 .1 .1"', -0.12, 0.02),  # two boxes 0.18 m apart, of 0.1 m half
    ('type="box" size=".1 .1 .1" quat=".9238795 0 .3826834 0"', -0.07, None),
    ('type="capsule" size=".05 .1" zaxis="0 1 0"', -0.16, 0.01),
    ('type="mesh" mesh="tip"', -0.105, 5e-3),
    ('type="box" size=".1 .1 .1"', -0.0995, None),
])  # fmt: skip
def test_pairs_that_overlap_at_first_are_said(shape, gap, depth, recwarn):
    """With MuJoCo's depth; of what floats nothing is said, because a file does not place it in the neutral pose."""
    model = mujoco.MjModel.from_xml_string(OVERLAPPING.format(shape=shape, gap=gap))
    spo.from_mujoco(model, pairs="all")
    found = [str(each.message) for each in recwarn.list if "overlap in the neutral pose" in str(each.message)]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    names = {frozenset((model.geom("a").id, model.geom("c").id))}
    truth = -min((c.dist for c in data.contact if frozenset(map(int, c.geom)) in names), default=0.0)
    assert depth is None or abs(truth - depth) < 1e-6
    if truth < 1e-3:
        assert not found
    else:
        (words,) = found
        assert "1 pair(s)" in words and f"a with c by {1e3 * truth:.3g} mm;" in words
        assert recwarn.list[0].filename == __file__
