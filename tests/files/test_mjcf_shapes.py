"""Margins of MJCF shapes against MuJoCo's constraints, shapes that MuJoCo cannot read, and files without contacts."""

import warnings

import mujoco
import numpy as np
import pytest

import warp_spo as spo
from warp_spo.reference.rotations import rotation

EXACT = 1e-12  # float64 on both sides; sizes of a metre
MARGINS = """<mujoco><option o_margin="0.07" o_friction="0.4 0.4 0.01 0.01 0.01"><flag override="{override}"/></option>
 <worldbody> <geom name="floor" type="plane" size="1 1 1" margin="0.03"/><body name="all" pos="0 0 0.05"><freejoint/>
 <geom name="ball" size="0.1" margin="0.05" gap="0.02"/><geom name="slab" type="box" size="0.1 0.2 0.03" margin="0.02"/>
 <geom name="stick" type="capsule" size="0.02 0.3"/><geom name="listed" size="0.12" margin="0.5"/></body></worldbody>
 <contact><pair geom1="listed" geom2="floor" margin="0.01" friction="0.6 0.6 0.01 0.01 0.01"/></contact></mujoco>"""


@pytest.mark.parametrize("override", ["disable", "enable"])
def test_margins_hold_shapes_where_mujoco_does(override):
    """Both margins, that of a pair, or the option's: depths are those of MuJoCo's constraints, frictions its own."""
    model, rng = mujoco.MjModel.from_xml_string(MARGINS.replace("{override}", override)), np.random.default_rng(2)
    scene = spo.from_mujoco(model, contacts="ground")
    qpos = np.array([0.0, 0.0, 0.02, *rng.normal(size=4)])
    qpos[3:] /= np.linalg.norm(qpos[3:])
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    want = {}
    for contact in data.contact:
        depth = (data.efc_pos - data.efc_margin)[contact.efc_address]
        name = model.geom(max(contact.geom)).name
        want[name] = min(want.get(name, np.inf), depth)
    up, found = rotation(qpos[[4, 5, 6, 3]])[2], {}
    for contact in scene.contacts:  # of the box eight spheres
        low = qpos[2] + (contact.positions @ up).min() - contact.radius
        found[contact.label] = min(found.get(contact.label, np.inf), low)
    assert found.keys() == want.keys() == {"ball", "slab", "stick", "listed"}
    np.testing.assert_allclose([found[name] for name in want], list(want.values()), atol=EXACT)
    friction = {c.label: c.friction for c in scene.contacts}
    assert (friction["listed"], friction["ball"]) == ((0.4, 0.4) if override == "enable" else (0.6, 1.0))


BASE = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" friction="0.2"/><body name="base">
 <geom name="sole" type="box" size="0.1 0.1 0.1" friction="0.3"/>
 <geom name="apart" size="0.5" contype="2" conaffinity="2"/>
 <body name="arm"><joint axis="0 1 0"/><geom name="rod" size="0.05" friction="0.25"/></body></body>
 </worldbody></mujoco>"""


def test_a_base_that_is_set_free_touches_as_the_file_says(tmp_path):
    """Shapes of a body that the file welds to the world have masks and friction, too, once floating= lets it move."""
    file = tmp_path / "base.xml"
    file.write_text(BASE)
    found = {c.label: c.friction for c in spo.load(file, floating=True, contacts="ground").contacts}
    assert found == {"sole": 0.3, "rod": 0.25}
    with pytest.warns(UserWarning, match="left out: box 'sole' of body 'base'"):
        assert [c.label for c in spo.load(file, contacts="ground").contacts] == ["rod"]


LOST = """<mujoco><asset><mesh name="hoof" file="nowhere.stl"/><texture type="2d" name="t" file="no.png"/></asset>
 <worldbody><geom name="floor" type="plane" size="1 1 1"/><body name="leg"><freejoint/>
 <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/><geom name="hoof" type="mesh" mesh="hoof" pos="0 0 -1"/>
 <geom name="ball" size="0.1"/></body></worldbody>
 <contact><pair geom1="ball" geom2="floor" friction="0.3 0.3 0.1 0.1 0.1"/></contact></mujoco>"""


def test_a_mesh_that_is_missing_touches_nothing(tmp_path):
    """Its place holder in MuJoCo's model is no contact; pairs of the file stay."""
    file = tmp_path / "lost.xml"
    file.write_text(LOST)
    with pytest.warns(UserWarning, match=r"nowhere.stl.*; mesh that MuJoCo cannot read 'hoof' of body 'leg'"):
        scene = spo.load(file, contacts="ground")
    assert [(c.label, c.friction) for c in scene.contacts] == [("ball", 0.3)]
    with pytest.raises(spo.UnsupportedError, match=r"contacts='hoof', which matches mesh that MuJoCo cannot read"):
        spo.load(file, contacts="hoof")


@pytest.mark.parametrize("flag, contacts", [("contact", True), ("constraint", "ground")])
def test_a_file_that_disables_contacts_is_obeyed(flag, contacts, tmp_path):
    """By True and "ground", with a warning; a pattern takes the shapes anyway."""
    file = tmp_path / "ball.xml"
    body = '<body name="b"><freejoint/><geom name="s" type="sphere" size="0.1"/></body>'
    text = '<mujoco><option>{}</option><worldbody><geom type="plane" size="1 1 1"/>{}</worldbody></mujoco>'
    file.write_text(text.format(f'<flag {flag}="disable"/>', body))
    with pytest.warns(UserWarning, match=r"left out: all contacts, which its options disable .*contacts='\*'"):
        scene = spo.load(file, contacts=contacts)
    assert not scene.contacts and scene.ground is None
    assert len(spo.load(file, contacts="*").contacts) == 1
    file.write_text(text.format("", body))
    assert len(spo.load(file, contacts=contacts).contacts) == 1


PENDULUM = """<mujoco><worldbody><geom name="rail" type="capsule" size=".02 1"
 quat=".7 0 .7 0" contype="2" conaffinity="2"/><body name="cart"><joint name="slide" type="slide" axis="1 0 0"/>
 <geom name="cart" type="capsule" size=".1 .1" quat=".7 0 .7 0"/><body name="pole"><joint name="turn" axis="0 1 0"/>
 <geom name="pole" type="capsule" fromto="0 0 0 .2 0 .6" size=".05"/></body></body></worldbody></mujoco>"""


def test_a_file_without_a_plane_has_no_floor(tmp_path):
    """A pendulum on a rail at height zero swings as in MuJoCo; a line says why, and ground= adds a floor."""
    file = tmp_path / "pendulum.xml"
    file.write_text(PENDULUM)
    with pytest.warns(
        UserWarning,
        match=r"left out: .*all contacts with a ground, because there is no plane .*ground=spo.Plane\(\) adds",
    ):
        scene = spo.load(file, contacts="ground")
    assert scene.ground is None and not scene.contacts
    model = mujoco.MjModel.from_xml_path(str(file))
    data, dyn, dt = mujoco.MjData(model), spo.Dynamics(scene, 1, dtype="float64"), 1e-3
    model.opt.timestep, model.opt.integrator = dt, mujoco.mjtIntegrator.mjINT_RK4
    data.qpos[1] = 1.0
    q, qd = np.array([data.qpos]), np.zeros((1, 2))
    for _ in range(100):
        mujoco.mj_step(model, data)
        q, qd = dyn.step(q, qd, dt=dt, options=spo.StepOptions("rk4"))
    assert not data.ncon and abs(data.qvel[1]) > 0.5
    np.testing.assert_allclose(qd[0], data.qvel, rtol=1e-9)
    assert {c.label for c in spo.load(file, contacts="ground", ground=spo.Plane(-1.0)).contacts} == {"cart", "pole"}
    assert spo.load(file, contacts="cart").ground.height == 0.0  # a pattern asks for a ground


MASKED = """<mujoco><default><default class="second"><geom contype="2" conaffinity="2"/></default></default><worldbody>
 <geom name="floor" type="plane" size="1 1 1" {floor}/><body name="base"><freejoint/>
 <geom name="sole" type="box" size="0.1 0.1 0.1"/><geom name="apart" type="sphere" size="0.5" class="second"/>
 <geom name="lone" type="sphere" size="0.05" contype="0" conaffinity="2"/><body name="arm"><joint axis="0 1 0"/>
 <geom name="rod" type="sphere" size="0.05" contype="0"/><geom name="tip" type="sphere" size="0.05" contype="4"
 conaffinity="0"/></body></body></worldbody><contact>{contact}</contact></mujoco>"""


def mujocos_contacts(file):
    """Return the friction of MuJoCo's contact with geom 'floor' by the other geom's name, all bodies at the origin."""
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = {}
    for contact in data.contact:
        names = {model.geom(geom).name for geom in contact.geom}
        if "floor" in names:
            (name,) = names - {"floor"}
            found[name] = contact.friction[0] if contact.dim > 1 else 0.0
    return found


@pytest.mark.parametrize("floor", ["", 'contype="2" conaffinity="2"', 'conaffinity="0"', 'contype="0" conaffinity="0"'])
@pytest.mark.parametrize("contact", ["", '<pair geom1="lone" geom2="floor"/>', '<pair geom1="tip" geom2="floor"/>'])
@pytest.mark.parametrize("exclude", ["", '<exclude body1="world" body2="base"/>'])
def test_masks_pairs_and_excludes_choose_what_touches_in_mujoco(floor, contact, exclude, tmp_path):
    """Shapes have contacts where MuJoCo finds some, and no others. A plane that can touch nothing is no ground."""
    file = tmp_path / "masked.xml"
    file.write_text(MASKED.format(floor=floor, contact=contact + exclude))
    wanted = mujocos_contacts(file).keys()
    assert {c.label for c in spo.load(file, contacts="ground").contacts} == wanted


def test_friction_that_differs_across_is_said_to_be_left_out(tmp_path):
    """A contact has one friction; MuJoCo's pairs have two."""
    file = tmp_path / "pair.xml"
    for friction, left_out in (("0.3 0.9", True), ("0.3 0.3", False)):
        file.write_text(
            "<mujoco><worldbody><geom name='floor' type='plane' size='1 1 1'/><body><freejoint/>"
            "<geom name='ball' size='.1'/></body></worldbody>"
            f"<contact><pair geom1='floor' geom2='ball' friction='{friction}'/></contact></mujoco>"
        )
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            (contact,) = spo.load(file, contacts="ground").contacts
        assert contact.friction == 0.3
        assert [str(each.message).partition("left out: ")[2] for each in said] == left_out * [
            "the friction 0.9 across of a contact pair of geom 'ball', which has 0.3 in all directions"
        ]


RUBBED = """<mujoco><default><geom friction="0.6"/><pair friction="0.35 0.35"/><default class="smooth">
 <geom friction="0.1"/><pair condim="1"/></default></default><worldbody>
 <geom name="floor" type="plane" size="1 1 1" {floor}/><body><freejoint/><geom name="plain" size="0.1"/>
 <geom name="one" size="0.1" condim="1"/><geom name="rough" size="0.1" friction="0.9" margin="0.02"/>
 <geom name="first" size="0.1" friction="0.3" priority="2"/><geom name="slick" size="0.1" class="smooth"/>
 <geom name="listed" size="0.1" margin="0.5" contype="0" conaffinity="0"/>
 <geom name="wet" size="0.1"/></body></worldbody><contact>
 <pair geom1="floor" geom2="listed" margin="0.07" friction="0.45 0.45" condim="3"/>
 <pair geom1="wet" geom2="floor" class="smooth"/></contact></mujoco>"""
FLOORS = ["", 'friction="0.8" condim="1"', 'friction="0.2" priority="1" condim="4" margin="0.05"', 'priority="2"']


@pytest.mark.parametrize("floor", FLOORS)
def test_friction_is_mujocos(floor, tmp_path):
    """The larger of both, or that of higher priority, zero in contacts of one dimension; a pair has its own."""
    file = tmp_path / "rubbed.xml"
    file.write_text(RUBBED.format(floor=floor))
    wanted, found = mujocos_contacts(file), {c.label: c.friction for c in spo.load(file, contacts="ground").contacts}
    assert len(found) == 7 and len(set(found.values())) > 2
    assert found == pytest.approx(wanted)


SOFT = """<mujoco><option {option}/><worldbody><geom name="floor" type="plane" size="1 1 1" {floor}/>
 <body name="b"><freejoint/><geom name="plain" size="0.1"/><geom name="slow" size="0.1" solref="0.05 1"/>
 <geom name="hard" size="0.1" solimp="0.99 0.99 0.01" solref="-100 -5"/><geom name="first" size="0.1" priority="2"/>
 <geom name="paired" size="0.1" solref="0.1 1"/></body></worldbody>
 <contact><pair geom1="floor" geom2="paired" {pair}/></contact></mujoco>"""


@pytest.mark.parametrize("floor", ["", 'solref="0.03 1"', 'priority="1" solimp="0.8 0.8 0.01"'])
@pytest.mark.parametrize("more", ["", 'solimp="0.5 0.6 0.01"', 'solreffriction="0.04 1"'])
def test_softness_that_is_not_mujocos_default_is_said_to_be_left_out(floor, more, tmp_path):
    """By the shapes whose contact with the floor MuJoCo makes with other values than its defaults."""
    file = tmp_path / "soft.xml"
    file.write_text(SOFT.format(floor=floor, pair=more, option=""))
    model = mujoco.MjModel.from_xml_path(str(file))
    data, wanted = mujoco.MjData(model), {}
    mujoco.mj_forward(model, data)
    usual = {"solref": [0.02, 1], "solreffriction": [0, 0], "solimp": [0.9, 0.95, 0.001, 0.5, 2]}
    for contact in data.contact:
        changed = [name for name, value in usual.items() if list(getattr(contact, name)) != value]
        wanted[model.geom(contact.geom[1]).name] = ", ".join(changed)
    assert len(wanted) == 5 and set(wanted.values()) > {""}
    with pytest.warns(UserWarning) as said:
        scene = spo.load(file, contacts="ground")
    message = str(said[0].message)
    for text in set(wanted.values()) - {""}:
        names = [f"sphere '{c.label}' of body 'b'" for c in scene.contacts if wanted[c.label] == text]
        assert f"{text} of {', '.join(names)} (contacts have none; stiffness and damping are chosen" in message
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # shapes that are not chosen, and defaults, say nothing
        spo.load(file, contacts="first", ground=spo.Plane())
    file.write_text(
        SOFT.format(floor="", pair="", option='o_solref="0.04 1"').replace(
            "/><worldbody>", '><flag override="enable"/></option><worldbody>'
        )
    )
    with pytest.warns(UserWarning, match="solref of sphere 'plain' of body 'b', sphere 'slow'"):
        spo.load(file, contacts="ground")


BELT = """<mujoco><worldbody><geom name="floor" type="plane" size="9 9 1" {floor}/>
 <body pos="0 0 {height}"><freejoint/><geom name="ball" size=".1" mass="1" {ball}/></body>
 <body pos="3 0 .1"><freejoint/><geom name="plain" size=".1" contype="0" conaffinity="2"/></body></worldbody>
 <contact>{pair}</contact></mujoco>"""
PAIR = '<pair geom1="floor" geom2="ball" {}/>'


@pytest.mark.parametrize("part", ["floor", "ball", "pair"])
@pytest.mark.parametrize(
    ("name", "value", "height", "pull"),
    [("surfacevel", "1 0 0", 0.099, 0.0), ("adhesion", "20", 0.0999, 15.0), ("gap", "-.01", 0.107, 0.0)],
)
def test_surfaces_that_move_stick_or_let_go_are_said_to_be_left_out(name, value, height, pull, part, tmp_path):
    """With the attribute MuJoCo accelerates the ball otherwise; the warning names it, and no other ball."""
    motions, file = [], tmp_path / "belt.xml"
    for more in ("", f'{name}="{value}"'):
        own = "floor" if (part, name) == ("pair", "surfacevel") else part
        parts = {key: more if key == own else "" for key in ("floor", "ball")}
        parts["ball"] += ' margin=".01"' if name == "gap" else ""
        rest = 'margin=".01"' if name == "gap" else ""
        pair = PAIR.format(f"{more if own == 'pair' else ''} {rest}") if part == "pair" else ""
        file.write_text(BELT.format(height=height, pair=pair, **parts))
        model = mujoco.MjModel.from_xml_path(str(file))
        data = mujoco.MjData(model)
        data.xfrc_applied[1, 2] = pull
        mujoco.mj_forward(model, data)
        motions.append(data.qacc.copy())
    assert np.abs(motions[1] - motions[0]).max() > 0.1
    with pytest.warns(UserWarning, match=rf"left out: {name} of sphere 'ball' of body 'body_0' \(contacts have none"):
        spo.load(file, contacts="ground")
