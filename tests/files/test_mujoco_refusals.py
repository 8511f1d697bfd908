"""Features of MuJoCo's models that no scene represents: each raises an error that names the element and a way out."""

import mujoco
import pytest

import warp_spo as spo

pytestmark = pytest.mark.filterwarnings("ignore:from_mujoco. left out")

MODEL = """<mujoco><option {option}/><worldbody><body name="base"><joint name="slide" type="slide"{slide}/>
 <geom size=".1"/> <site name="s"/><body name="arm" {arm} pos="0 0 1"><joint name="turn" axis="0 1 0" {turn}/>
 <geom size=".1" pos=".3 0 0"/> <site name="t" pos=".3 0 0"/><body name="tip">
 <joint name="ball" type="ball" {ball}/><geom size=".1"/></body></body>
 </body>{world}</worldbody>{more}</mujoco>"""
EMPTY = dict.fromkeys(("option", "slide", "arm", "turn", "ball", "world", "more"), "")
FIXED = '<tendon><fixed name="sum" {}><joint joint="slide" coef="1"/><joint joint="turn" coef="2"/></fixed></tendon>'
ACT = '<actuator><{} name="drive" joint="turn" {}/></actuator>'
FLEX = '<flexcomp name="rope" type="grid" count="3 1 1" spacing=".1 .1 .1" dim="1"/>'
SPATIAL = '<tendon><spatial name="rope"><site site="s"/><site site="t"/></spatial></tendon>'
CASES = {
    "fluid": ({"option": 'density="1.2"'}, "fluid forces (<option density=1.2>)", "set density to 0"),
    "viscosity": ({"option": 'viscosity="0.1"'}, "fluid forces (<option viscosity=0.1>)", "set viscosity to 0"),
    "flex": ({"world": FLEX}, "flex 'rope', a deformable body,", "remove <flex>"),
    "stiffness": ({"turn": 'stiffness="1 0 2"'}, "joint 'turn', which has polynomial stiffness,", "linear"),
    "damping": ({"slide": ' damping="1 2"'}, "joint 'slide', which has polynomial damping,", "linear"),
    "yield": ({"turn": 'stiffness="1" springyield=".1"'}, "joint 'turn', which has plasticity", "springyield"),
    "ball range": (
        {"ball": 'range="0 1" limited="true"'},
        "joint 'ball', a ball joint with a limited range,",
        "hinges",
    ),
    "ball friction": ({"ball": 'frictionloss="1"'}, "joint 'ball', a ball joint with frictionloss,", "hinges"),
    "spatial": ({"more": SPATIAL}, "tendon 'rope', a spatial tendon,", "remove it"),
    "tendon spring": ({"more": FIXED.format('stiffness="1"')}, "tendon 'sum', which has stiffness,", "through tau"),
    "tendon damper": ({"more": FIXED.format('damping="1"')}, "tendon 'sum', which has damping,", "through tau"),
    "tendon armature": ({"more": FIXED.format('armature="1"')}, "tendon 'sum', which has armature,", "joints"),
    "tendon friction": ({"more": FIXED.format('frictionloss="1"')}, "tendon 'sum', which has frictionloss,", "joints"),
    "tendon range": (
        {"more": FIXED.format('range="0 1" limited="true"')},
        "tendon 'sum', which has a limited",
        "range",
    ),
    "filter": ({"more": ACT.format("general", 'dyntype="filter"')}, "actuator 'drive', which has an activation", "tau"),
    "integrator": ({"more": ACT.format("intvelocity", 'actrange="0 1"')}, "(dyntype integrator)", "tau"),
    "muscle": ({"more": ACT.format("muscle", 'lengthrange="0 1"')}, "actuator 'drive', a muscle,", "tau"),
    "cogging": (
        {"more": ACT.format("dcmotor", 'motorconst="1" resistance="1" cogging="1 2 3"')},
        "a DC motor with",
        "tau",
    ),
    "damper": ({"more": ACT.format("damper", 'kv="1" ctrlrange="0 1"')}, "actuator 'drive', whose gain depends", "tau"),
    "delay": ({"more": ACT.format("motor", 'delay=".1" nsample="9"')}, "actuator 'drive', which has a", "remove"),
    "site": ({"more": '<actuator><motor name="jet" site="s"/></actuator>'}, "a site transmission,", "tau"),
    "body": (
        {"more": '<actuator><adhesion name="glue" body="arm" ctrlrange="0 1"/></actuator>'},
        "actuator 'glue', which has a body transmission (adhesion),",
        "tau",
    ),
    "crank": (
        {"more": '<actuator><motor name="m" slidersite="s" cranksite="t" cranklength="1"/></actuator>'},
        "actuator 'm', which has a slider-crank transmission,",
        "tau",
    ),
    "ball motor": ({"more": '<actuator><motor name="m" joint="ball"/></actuator>'}, "acts on joint 'ball'", "hinges"),
    "two bounded": (
        {
            "turn": 'actuatorfrcrange="-1 2" actuatorfrclimited="true"',
            "more": '<actuator><motor joint="turn"/><motor joint="turn"/></actuator>',
        },
        "joint 'turn', whose uneven actuatorfrcrange bounds the sum of several actuators",
        "forcerange",
    ),
    "actuatorgravcomp": (
        {"arm": 'gravcomp="1"', "turn": 'actuatorgravcomp="true"'},
        "joint 'turn', which has actuatorgravcomp,",
        "passive_force",
    ),
    "quadratic": (
        {"more": '<equality><joint name="e" joint1="slide" joint2="turn" polycoef="0 1 2 0 0"/></equality>'},
        "equality 'e', a polynomial of degree two or more,",
        "polycoef",
    ),
    "one joint": (
        {"more": '<equality><joint name="e" joint1="slide"/></equality>'},
        "equality 'e', which ties 1 joint(s),",
        "two joints",
    ),
    "three joints": (
        {
            "world": '<body><joint name="more"/><geom size=".1"/></body>',
            "more": '<equality><tendon name="e" tendon1="sum" tendon2="more"/></equality>'
            + FIXED.format("").replace(
                "</tendon>", '<fixed name="more"><joint joint="more" coef="1"/></fixed></tendon>'
            ),
        },
        "equality 'e', which ties 3 joint(s),",
        "two joints",
    ),
}
LATER = ("yield",)  # MuJoCo 4 has it, 3 refuses the attribute


@pytest.mark.parametrize("name", CASES)
def test_refused_by_name(name):
    change, what, way_out = CASES[name]
    try:
        model = mujoco.MjModel.from_xml_string(MODEL.format(**EMPTY | change))
    except ValueError:
        assert name in LATER and mujoco.__version__.startswith("3.")
        return
    with pytest.raises(spo.UnsupportedError) as caught:
        spo.from_mujoco(model)
    message = str(caught.value)
    assert (
        message.startswith("from_mujoco: ") and what in message and way_out in message.split(" is not supported; ")[1]
    )


def test_the_model_without_any_of_them_is_read():
    assert spo.from_mujoco(mujoco.MjModel.from_xml_string(MODEL.format(**EMPTY))).dof_count == 5


def test_distance_equalities_of_a_model():
    """No longer in MJCF, but in the enumeration."""
    more = '<equality><connect name="e" body1="arm" anchor="0 0 0"/></equality>'
    model = mujoco.MjModel.from_xml_string(MODEL.format(**EMPTY | {"more": more}))
    model.eq_type[0] = mujoco.mjtEq.mjEQ_DISTANCE
    with pytest.raises(spo.UnsupportedError, match="equality 'e', a distance equality"):
        spo.from_mujoco(model)


def test_values_that_differ_between_axes_of_a_ball():
    model = mujoco.MjModel.from_xml_string(MODEL.format(**EMPTY))
    model.dof_armature[-1] = 1.0
    with pytest.raises(spo.UnsupportedError, match="joint 'ball', a ball joint with armature that differs"):
        spo.from_mujoco(model)
