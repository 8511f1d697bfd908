"""MJCF that Newton's importer, which reads it without the package mujoco, reads differently from MuJoCo.

Each case raises an error that names the element.
"""

import re

import numpy as np
import pytest

from support.newton_models import FLOAT32, MJCF
from warp_spo.errors import UnsupportedError
from warp_spo.newton import load

mujoco = pytest.importorskip("mujoco")
pytestmark = pytest.mark.usefixtures("newtons_importer")

MISREAD = """<mujoco><compiler{compiler}/>
  <default><joint{main}/><default class="c"><joint{c}/><geom{c_geom}/></default></default>
  <worldbody><body name="root"><joint{root}/><geom size=".1"/><frame childclass="c"><body name="tip"><joint{tip}/>{more}
  <geom size=".1"{geom}/></body></frame></body></worldbody></mujoco>"""
EMPTY = dict.fromkeys(("compiler", "main", "c", "c_geom", "root", "tip", "more", "geom"), "")
INERTIA = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
SLIDE = '<joint type="slide"/>'


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ({"root": ' ref="1"'}, "a joint's ref (body 'root')"),
        ({"main": ' ref="1"'}, "a joint's ref (body 'root', 'tip')"),
        ({"c": ' ref="1"'}, "a joint's ref (body 'tip')"),
        ({"c": ' ref="1"', "tip": ' class="main"'}, None),
        ({"c": ' ref="1"', "tip": ' ref="0"'}, None),
        ({"c": ' ref="1"', "root": ' class="c"', "tip": ' type="ball"'}, "a joint's ref (body 'root')"),
        ({"more": SLIDE}, "a slide after a hinge or ball (body 'tip')"),
        ({"tip": ' type="ball"', "more": SLIDE}, "a slide after a hinge or ball (body 'tip')"),
        ({"tip": ' type="slide"', "more": SLIDE + "<joint/>"}, None),
        ({"c": ' type="slide"', "more": '<joint type="hinge"/>'}, None),
        ({"root": ' pos="1 0 0"'}, None),
        ({"c": ' pos="0 0 1"', "more": '<joint axis="1 0 0"/>'}, None),
        ({"c": ' pos="0 0 1"', "more": '<joint axis="1 0 0" pos="0 0 0"/>'}, "joints with different pos (body 'tip')"),
        ({"tip": ' type="slide" pos="0 0 1"', "more": "<joint/>"}, "joints with different pos (body 'tip')"),
        ({"tip": ' type="slide"', "more": '<joint type="slide" pos="0 0 1" axis="1 0 0"/>'}, None),
        ({"c_geom": ' shellinertia="true"'}, "a geom's shellinertia (body 'tip')"),
        ({"geom": ' shellinertia="true"', "more": INERTIA}, None),
        (
            {"geom": ' shellinertia="true"', "more": INERTIA, "compiler": ' inertiafromgeom="true"'},
            "a geom's shellinertia (body 'tip')",
        ),
        ({"geom": ' shellinertia="true" mass="0"', "more": '<geom size=".1"/>'}, None),
        (
            {
                "geom": ' shellinertia="true" group="3"',
                "more": '<geom size=".1"/>',
                "compiler": ' inertiagrouprange="0 2"',
            },
            None,
        ),
        ({"compiler": ' settotalmass="2"'}, "<compiler settotalmass> (body 'root', 'tip')"),
        ({"compiler": ' settotalmass="-1"'}, None),
        ({"geom": ' type="box" fromto="0 0 0 0 0 1"'}, "a box or ellipsoid with fromto (body 'tip')"),
        (
            {"c_geom": ' type="ellipsoid"', "geom": ' fromto="0 0 0 0 0 1"'},
            "a box or ellipsoid with fromto (body 'tip')",
        ),
        ({"geom": ' type="capsule" fromto="0 0 0 0 0 1"'}, None),
        ({"geom": ' type="box" fromto="0 0 0 0 0 1"', "more": INERTIA}, None),
        ({"tip": ' type="ball" range="0 1"'}, "a ball's range (body 'tip')"),
        ({"tip": ' type="ball" range="0 1" limited="false"'}, None),
        ({"c": ' springdamper="1 1"'}, "a joint's springdamper (body 'tip')"),
        ({"more": '<body name="hand" gravcomp="1"/>'}, "gravcomp (body 'hand')"),
        ({"main": ' armature="1"', "root": ' type="free"'}, "armature or damping of a free joint (body 'root')"),
        ({"more": '<flexcomp name="f" type="grid"/>'}, "a <composite>, <flexcomp> or <flex> (body 'tip')"),
        ({"more": '<frame><attach model="m" body="b" prefix="p"/></frame>'}, "an <attach> (body 'tip')"),
    ],
)
def test_mjcf_that_newton_misreads(text, found, tmp_path):
    """By default class, childclass and frame, and only where it changes the robot."""
    file = tmp_path / "robot.xml"
    file.write_text(MISREAD.format(**EMPTY | text))
    if found is None:
        assert load(file).body_labels[-1].endswith("tip")
    else:
        with pytest.raises(UnsupportedError, match=re.escape(f"load: {str(file)!r} with {found} is not supported; ")):
            load(file)


LOST = """<mujoco>{default}<worldbody>{before}<body name="root"><joint name="j"{pos}/><geom size=".1"/>{root}
  <body name="tip" childclass="c"><joint{tip}/><geom size=".1"/>{more}</body></body></worldbody></mujoco>"""
PLAIN = dict(default='<default><default class="c"/></default>', before="", pos="", root="", tip="", more="")


@pytest.mark.parametrize(
    ("text", "floating", "found"),
    [
        ({"more": "<frame><joint/></frame>"}, None, "a joint or inertial in a <frame> (body 'tip')"),
        ({"more": f"<frame><frame>{INERTIA}</frame></frame>"}, None, "a joint or inertial in a <frame> (body 'tip')"),
        ({"root": "<frame><freejoint/></frame>"}, None, "a joint or inertial in a <frame> (body 'root')"),
        ({"root": "<frame><freejoint/></frame>"}, True, None),
        ({"more": '<frame><geom size=".1"/><site/></frame>'}, None, None),
        ({"before": '<replicate count="2"><body/></replicate>'}, None, "a <replicate> (body 'world')"),
        ({"before": '<replicate count="2"><geom size=".1"/></replicate>'}, None, None),
        ({"more": '<replicate count="2"><geom size=".1"/></replicate>'}, None, "a <replicate> (body 'tip')"),
        ({"more": f'{INERTIA}<frame><replicate count="2"><geom size=".1"/></replicate></frame>'}, None, None),
        ({"more": '<frame><replicate count="2"><body/></replicate></frame>'}, None, "a <replicate> (body 'tip')"),
        ({"pos": ' pos="1 0 0"'}, False, "a root joint's pos under floating=False (body 'root')"),
        ({"pos": ' pos="1 0 0"'}, None, None),
        ({"pos": ' pos="1 0 0"'}, True, None),
        ({"tip": ' pos="1 0 0"'}, False, None),
        (
            {"default": '<default class="robot"><default class="c"/></default>'},
            None,
            "an outermost <default> with a class of its own (class 'robot')",
        ),
    ],
)
def test_mjcf_that_newton_loses(text, floating, found, tmp_path):
    """In frames, copies and a fixed base, and only where it changes the robot."""
    file = tmp_path / "robot.xml"
    file.write_text(LOST.format(**PLAIN | text))
    if found is None:
        assert load(file, floating=floating).body_labels[-1].endswith("tip")
    else:
        with pytest.raises(UnsupportedError, match=re.escape(f"load: {str(file)!r} with {found} is not supported; ")):
            load(file, floating=floating)


SERVO = """<mujoco><default><position{default}/></default><worldbody><body><joint name="j"/><geom size=".1"/></body>
  </worldbody><actuator><position name="servo" joint="j" kp="30"{own}/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("default", "own", "refused"),
    [
        ("", ' gear="5"', True),
        (' forcerange="-2 2"', "", True),
        ("", ' dampratio="1"', True),
        ("", ' kv="2" gear="1"', False),
        ("", ' forcerange="-2 2" forcelimited="false"', False),
    ],
)
def test_servos_of_which_newton_reads_the_gains_alone(default, own, refused, tmp_path):
    file = tmp_path / "robot.xml"
    file.write_text(SERVO.format(default=default, own=own))
    if refused:
        with pytest.raises(UnsupportedError, match=r"actuator with gear, .* \(actuator 'servo'\).*package mujoco"):
            load(file)
    else:
        np.testing.assert_array_equal(load(file).values["joint_target_ke"], [[30.0]])


def test_parts_that_newton_leaves_out_are_counted(tmp_path):
    file = tmp_path / "robot.xml"
    more = '</worldbody><actuator><motor joint="j"/></actuator><keyframe><key/><key/></keyframe><worldbody>'
    file.write_text(LOST.format(**PLAIN | {"root": '<site name="s"/>'}).replace("</worldbody>", more + "</worldbody>"))
    with pytest.warns(UserWarning, match="1 actuator, 2 keyframes, 1 site left out; install the package mujoco"):
        load(file)


def test_numbers_that_are_none(tmp_path):
    file = tmp_path / "robot.xml"
    file.write_text(LOST.format(**PLAIN | {"pos": ' armature="much" pos="a b c"'}))
    with pytest.raises(ValueError, match=r"^load: '.*robot.xml': .*'a'"):
        load(file)


ELEMENTS = '<joint armature="2"/><geom density="10"/>'
INNER = '<default class="c"><joint armature="7"/></default>'


@pytest.mark.parametrize(
    "default",
    [
        f"<default>{ELEMENTS}{INNER}</default>",
        f'<default class="main">{ELEMENTS}{INNER}</default>',
        f'<default class="main"><joint armature="2"/></default><default><geom density="10"/>{INNER}</default>',
        f'<default><joint armature="1" damping="3"/></default><default class="main">{ELEMENTS}{INNER}</default>',
        f'<default><geom density="10"/></default><default><geom size=".2"/><joint armature="2"/>{INNER}</default>',
    ],
)
def test_mjcf_default_class_main(default, tmp_path):
    """Outermost defaults are everybody's, and an element steps out of its childclass by "main", as in MuJoCo."""
    file = tmp_path / "robot.xml"
    text = {"default": default, "tip": ' class="main"', "more": '<joint axis="1 0 0"/>'}
    file.write_text(LOST.format(**PLAIN | text))
    model, scene = mujoco.MjModel.from_xml_path(str(file)), load(file)
    np.testing.assert_allclose(model.dof_armature, [2, 2, 7])
    np.testing.assert_allclose(scene.values["joint_armature"], [model.dof_armature])
    np.testing.assert_allclose(scene.values["joint_damping"], [model.dof_damping])
    np.testing.assert_allclose(scene.values["body_mass"][0], model.body_mass[1:], rtol=FLOAT32)


def test_mjcf_default_class_main_beside_meshes(tmp_path):
    """Text has no folder to find them in."""
    file, asset = tmp_path / "robot.xml", '<asset><mesh name="m" file="no.stl"/></asset><default class="main"/>'
    file.write_text(MJCF.format(asset=asset, tip='<geom type="mesh" mesh="m"/>'))
    with pytest.raises(UnsupportedError, match=r"default class 'main' beside masses from meshes.*remove class='main'"):
        load(file)
    file.write_text(MJCF.format(asset=asset, tip=INERTIA + '<geom type="mesh" mesh="m"/>'))
    np.testing.assert_allclose(load(file).values["body_mass"][0, 1], 1.0)


def test_mjcf_that_newton_misreads_in_an_include(tmp_path):
    """Each finding and each way out once. Joints of a root body do not count where ``floating`` replaces them."""
    joints = '<joint ref="1"/><joint type="slide" pos="1 0 0"/>'
    (tmp_path / "tip.xml").write_text(f"<mujocoinclude>{joints}</mujocoinclude>")
    file = tmp_path / "robot.xml"
    file.write_text('<mujoco><worldbody><body><geom size=".1"/><include file="tip.xml"/></body></worldbody></mujoco>')
    with pytest.raises(UnsupportedError) as caught:
        load(file)
    where = "(body 'world/(no name)')"
    assert f"with a slide after a hinge or ball {where}, a joint's ref {where} is" in str(caught.value)
    assert str(caught.value).count("; ") == 2
    assert load(file, floating=True).dof_count == 6
