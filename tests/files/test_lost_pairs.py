"""Contacts between bodies, which a scene of an MJCF has not: said where MuJoCo makes one, and only there."""

import mujoco
import numpy as np
import pytest

import warp_spo as spo
from warp_spo.mujoco.collision_shapes import touching_bodies
from warp_spo.mujoco.source import Source
from warp_spo.scene.collision_shapes import moving_bodies

BALL = '<geom name="{0}" size=".1" contype="{1}" conaffinity="{2}"/>'


def balls(rng):
    """Return a random tree of balls that all lie at one point: masks, exclusions, pairs, rigid and still pieces."""
    count, text, close = rng.integers(2, 5), "", 0
    for i in range(count):
        joint = rng.choice(["", '<joint axis="0 0 1"/>', '<joint axis="0 0 1"/>'])
        ball = BALL.format(f"g{i}", *rng.choice([0, 0, 1, 2, 3], 2))
        text += f'<body name="b{i}"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>{joint}{ball}'
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
    rng, found = np.random.default_rng(0), []
    for _ in range(150):
        model = mujoco.MjModel.from_xml_string(balls(rng))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        pieces = model.body_weldid[model.geom_bodyid[data.contact.geom]]  # of each contact; 0 is the world
        pushes = (pieces != 0).all(axis=1) & (pieces[:, 0] != pieces[:, 1])  # an explicit pair may lie in one piece
        wanted = {frozenset(map(int, pair)) for pair in data.contact.geom[pushes]}
        moving = np.array(model.body_weldid[1:]) != 0
        pair = touching_bodies(Source(model), moving)
        assert (pair is None) == (not wanted), (pair, wanted)
        assert pair is None or frozenset(pair) in wanted
        found.append(pair is None)
    assert 30 < sum(found) < 120


TEXT = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"{0}/>
 <body name="hand"><freejoint/><geom name="palm" size=".1"{0}/></body>
 <body name="cube"><freejoint/><geom name="side" type="box" size=".1 .1 .1"{0}/></body>
 </worldbody><contact>{1}</contact></mujoco>"""
OFF = ' contype="0" conaffinity="0"'
PAIRS = '<pair geom1="palm" geom2="floor"/><pair geom1="side" geom2="palm"/>'


@pytest.mark.parametrize("off, pairs", [("", ""), (OFF, PAIRS)])
def test_a_warning_names_a_pair(off, pairs):
    model = mujoco.MjModel.from_xml_string(TEXT.format(off, pairs))
    words = (
        r"left out: contacts between bodies, such as geom '(palm|side)' with geom '(palm|side)' \(spo.Contact\(other="
    )
    with pytest.warns(UserWarning, match=words):
        scene = spo.from_mujoco(model, contacts=True)
    assert scene.contacts and moving_bodies(scene).all()
    with pytest.warns(UserWarning, match=r"left out: contacts of 3 geom\(s\), geom 'floor' among them"):
        spo.from_mujoco(model)


def test_contacts_with_the_ground_alone_warn_of_no_bodies(recwarn):
    model = mujoco.MjModel.from_xml_string(TEXT.format("", ""))
    assert len(spo.from_mujoco(model, contacts="ground").contacts) == 2
    assert not recwarn.list


def test_no_warning_where_bodies_only_touch_the_ground(recwarn):
    text = TEXT.format("", "").replace('name="palm" size=".1"', 'name="palm" size=".1" contype="2" conaffinity="1"')
    text = text.replace('name="side"', 'name="side" contype="4" conaffinity="1"')
    assert len(spo.from_mujoco(mujoco.MjModel.from_xml_string(text), contacts=True).contacts) == 2
    assert not recwarn.list
