"""MJCF files with attributes at random: ``ATTRIBUTES`` names them, and what becomes of each in a scene.

A file is a floating trunk with limbs, limbs on the world whose limits are compared, bodies whose frames are written in
each of MJCF's ways, geoms of each type, constraints, tendons and actuators. ``mjcf_misreadings.py`` compares.
"""

import dataclasses
from collections.abc import Callable

import numpy as np


def number(low, high):
    return lambda rng: f"{rng.uniform(low, high):.17g}"


def numbers(*ranges):
    return lambda rng: " ".join(f"{rng.uniform(low, high):.17g}" for low, high in ranges)


def vector(size=3, low=-0.3, high=0.3):
    return numbers(*[(low, high)] * size)


def word(*words):
    return lambda rng: str(rng.choice(words))


def direction(size=3):
    return lambda rng: " ".join(f"{x:.17g}" for x in rng.normal(size=size))


def square_axes(rng):
    x, y = rng.normal(size=(2, 3))
    return " ".join(f"{value:.17g}" for value in (*x, *(y - x * (x @ y) / (x @ x))))


def bent_tensor(rng):
    """Entries of an inertia that a rigid body can have [xx yy zz xy xz yz]."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    inertia = axes @ np.diag(rng.uniform(0.01, 0.019, 3)) @ axes.T
    return " ".join(f"{inertia[i, j]:.17g}" for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))


@dataclasses.dataclass(frozen=True)
class Attribute:
    """An attribute that a file may have.

    Args:
        element: key of ``ELEMENTS``. name: its name. draw: returns a value that is not the default.
        outcome: "right"; or "warned" or "refused", with ``words`` of the message. needs: what it needs to have a
            meaning, values by (element, name).
    """

    element: str
    name: str
    draw: Callable
    outcome: str = "right"
    words: str = ""
    needs: tuple = ()

    def drawn(self, rng):
        """Return the attribute with one value for good."""
        value = self.draw(rng)
        return dataclasses.replace(self, draw=lambda _: value)

    @property
    def named(self):
        """Tag and attribute, as users know them; of actuators the tag is "actuator"."""
        return f"{ELEMENTS[self.element][0]}.{self.name}"


ELEMENTS = {  # tag and attributes that always stand there, whose values others take the place of
    "compiler": ("compiler", {"angle": "radian"}),
    "option": ("option", {}),
    "flag": ("flag", {}),
    "default joint": ("joint", {}),
    "default geom": ("geom", {}),
    "default servo": ("position", {}),
    "class joint": ("joint", {}),
    "mesh": ("mesh", {"name": "tetra", "vertex": "0 0 0 .3 0 0 0 .2 0 0 0 .1 .2 .2 .2"}),
    "trunk": ("body", {"name": "trunk"}),
    "root": ("joint", {"name": "root", "type": "free"}),
    "trunk geom": ("geom", {"name": "trunk", "type": "box", "size": ".2 .1 .05"}),
    "turn body": ("body", {"name": "turn"}),
    "turn": ("joint", {"name": "turn", "axis": "0 1 0"}),
    "turn geom": ("geom", {"name": "turn", "type": "capsule", "size": ".05 .2 .1"}),
    "slide body": ("body", {"name": "slide"}),
    "slide": ("joint", {"name": "slide", "type": "slide", "axis": "0 0 1"}),
    "slide geom": ("geom", {"name": "slide", "type": "cylinder", "size": ".06 .1 .1"}),
    "ball body": ("body", {"name": "ball"}),
    "ball": ("joint", {"name": "ball", "type": "ball"}),
    "ball geom": ("geom", {"name": "ball", "type": "ellipsoid", "size": ".1 .15 .2"}),
    "two geom": ("geom", {"name": "two", "type": "box", "size": ".05 .06 .07"}),
    "mesh geom": ("geom", {"name": "mesh", "type": "mesh", "mesh": "tetra"}),
    "group geom": ("geom", {"name": "group", "size": ".07 .07 .07"}),
    "weighed body": ("body", {"name": "weighed"}),
    "weighed": ("joint", {"name": "weighed", "axis": "1 0 1"}),
    "inertial": ("inertial", {"pos": "0 0 0", "mass": "1", "diaginertia": ".1 .1 .1"}),
    "full": ("inertial", {"pos": ".1 0 0", "mass": "1", "diaginertia": ".1 .1 .1"}),
    "full joint": ("joint", {"name": "full", "axis": "1 1 1"}),
    "by axis": ("body", {"name": "by_axis"}),
    "by xy": ("body", {"name": "by_xy"}),
    "by z": ("body", {"name": "by_z"}),
    "frame": ("frame", {}),
    "by axis geom": ("geom", {"size": ".03 .2", "type": "capsule"}),
    "by xy geom": ("geom", {"size": ".03 .2", "type": "capsule"}),
    "by z geom": ("geom", {"size": ".03 .2", "type": "capsule"}),
    "by euler geom": ("geom", {"size": ".03 .2", "type": "capsule"}),
    "hang": ("joint", {"name": "hang", "axis": "0 1 0", "limited": "true", "range": "-.3 3"}),
    "drop": ("joint", {"name": "drop", "type": "slide", "axis": "0 .6 .8", "limited": "true", "range": "-.2 .3"}),
    "tied": ("joint", {"name": "tied", "axis": "0 1 0", "range": "-.7 .7"}),
    "mocap": ("body", {"name": "mocap"}),
    "floor": ("geom", {"name": "floor", "type": "plane", "size": "9 9 1", "pos": "0 0 50"}),
    "tool": ("site", {"name": "tool"}),
    "by fromto": ("site", {"name": "by_fromto", "type": "capsule"}),
    "by euler": ("site", {"name": "by_euler"}),
    "connect": ("connect", {"name": "connect", "body1": "hang", "body2": "drop", "anchor": "0 0 0"}),
    "connect sites": ("connect", {"name": "connect_sites", "site1": "tool", "site2": "by_euler"}),
    "weld": ("weld", {"name": "weld", "body1": "turn", "body2": "tied"}),
    "coupling": ("joint", {"name": "coupling", "joint1": "weighed", "joint2": "full", "polycoef": "0 1 0 0 0"}),
    "tie": ("tendon", {"name": "tie", "tendon1": "sum", "polycoef": "0 1 0 0 0"}),
    "sum": ("fixed", {"name": "sum"}),
    "of turn": ("joint", {"joint": "turn", "coef": "1"}),
    "motor": ("motor", {"name": "motor", "joint": "turn"}),
    "pull": ("motor", {"name": "pull", "tendon": "sum"}),
    "servo": ("position", {"name": "servo", "joint": "slide"}),
    "ranged": ("position", {"name": "ranged", "joint": "drop"}),
    "speed": ("velocity", {"name": "speed", "joint": "hang", "ctrlrange": "-.2 .2"}),
    "any": ("general", {"name": "any", "joint": "weighed", "biastype": "affine", "forcerange": "-.2 .3"}),
    "dc": ("dcmotor", {"name": "dc", "jointinparent": "full", "motorconst": "1", "resistance": "1"}),
    "key": ("key", {"name": "home"}),
}
FILE = """<mujoco><{compiler}/><{option}><{flag}/></option>
<default><{default joint}/><{default geom}/><{default servo}/><default class="own"><{class joint}/></default></default>
<asset><{mesh}/></asset>
<worldbody><{floor}/>
<{trunk}><{root}/><{trunk geom}/><{tool}/><{by fromto}/>
 <{turn body}><{turn}/><{turn geom}/><{group geom}/>
  <{slide body}><{slide}/><{slide geom}/><{two geom}/><{by euler}/></body>
  <{ball body}><{ball}/><{ball geom}/><{mesh geom}/></body></body>
 <{weighed body}><{weighed}/><{inertial}/><geom name="weighed" size=".08"/>
  <body><{full joint}/><{full}/><geom size=".09"/></body><body><geom size=".06" pos=".1 .2 0"/></body></body>
 <{by axis}><joint/><{by axis geom}/></body><{by xy}><joint/><{by xy geom}/></body><{by z}><joint/><{by z geom}/></body>
 <{frame}><body><joint axis="1 0 0"/><{by euler geom}/></body></frame>
</body>
<body name="hang"><{hang}/><geom type="capsule" size=".03" fromto="0 0 0 .4 0 .1"/></body>
<body name="drop" pos="0 2 0"><{drop}/><geom size=".1"/></body>
<body name="tied" pos="1 0 0"><{tied}/><geom size=".1" pos=".1 .1 0"/></body>
<{mocap}><geom size=".1"/></body></worldbody>
<equality><{connect}/><{connect sites}/><{weld}/><{coupling}/><{tie}/></equality>
<tendon><{sum}><{of turn}/><joint joint="slide" coef="-.7"/></fixed></tendon>
<actuator><{motor}/><{pull}/><{servo}/><{ranged}/><{speed}/><{any}/><{dc}/></actuator>
<keyframe><{key}/></keyframe></mujoco>"""
QPOS = ((-1, 1),) * 3 + ((0.5, 1),) * 4 + ((-1, 1),) * 2 + ((0.5, 1),) * 4 + ((-1, 1),) * 9
QVEL = ((-1, 1),) * 20
SOFT = r"the softness \(solref, solimp\) of (equality '\w+', )*equality"
SOFTNESS = {"solref": numbers((0.03, 0.1), (0.3, 0.9)), "solimp": numbers((0.5, 0.7), (0.8, 0.9), (0.01, 0.1))}
TURNS = {"quat": direction(4), "euler": vector(3, -2, 2), "axisangle": direction(4)} | {
    "zaxis": direction(),
    "xyaxes": square_axes,
}
GAINS = {"gainprm": number(2, 9), "biasprm": vector(3, -5, 5)}


def _right(element, **draws):
    return [Attribute(element, name, draw) for name, draw in draws.items()]


def _frames(element, turn):
    return _right(element, pos=vector(), **{turn: TURNS[turn]})


def _of_scalar(joint):
    """Attributes of a hinge or a slide."""
    return [
        *_right(
            joint,
            pos=vector(),
            axis=direction(),
            ref=number(-1, 1),
            springref=number(-1, 1),
            stiffness=number(1, 5),
            damping=number(0.5, 3),
            armature=number(0.1, 1),
            frictionloss=number(0.1, 2),
        ),
        Attribute(joint, "springdamper", numbers((0.1, 0.3), (0.3, 0.9))),
    ]


RIGHT = [
    *_right("compiler", angle=word("degree"), eulerseq=word("XYZ", "zxz", "yzx"), inertiafromgeom=word("true")),
    *_right("compiler", inertiagrouprange=word("0 2"), settotalmass=number(5, 20), boundmass=number(0.5, 2)),
    *_right("compiler", boundinertia=number(0.02, 0.1), balanceinertia=word("true")),
    *_right("compiler", alignfree=word("true"), fusestatic=word("true")),
    *_right("option", gravity=vector(3, -10, 10), timestep=number(0.012, 0.02)),
    *_right("flag", **dict.fromkeys(("gravity", "spring", "damper", "limit", "frictionloss"), word("disable"))),
    *_right("flag", **dict.fromkeys(("clampctrl", "refsafe", "contact"), word("disable"))),
    *_right("default joint", damping=number(0.2, 1), armature=number(0.1, 0.5), stiffness=number(0.3, 2)),
    *_right("default geom", density=number(200, 700), friction=number(0.2, 0.6)),
    *_right("default servo", kp=number(20, 60)),
    *_right("class joint", damping=number(2, 3), springref=number(-1, 1)),
    *_right("mesh", scale=vector(3, 0.5, 2), refpos=vector(), refquat=direction(4), inertia=word("convex", "shell")),
    *_frames("trunk", "quat"),
    *_right("trunk", gravcomp=number(0.2, 0.9)),
    *_right("root", armature=number(0.1, 1), damping=number(0.5, 2), stiffness=number(1, 5)),
    *_right("trunk geom", size=vector(3, 0.05, 0.3), mass=number(2, 5), pos=vector(), quat=direction(4)),
    *_right("trunk geom", friction=numbers((0.2, 1.5)), priority=word("1", "2"), condim=word("1")),
    *_frames("turn body", "euler"),
    *_right("turn body", gravcomp=number(0.2, 0.9), childclass=word("own")),
    *_of_scalar("turn"),
    *_right("turn", actuatorfrcrange=word("-1 1", "-.7 .7")),
    *_right("turn geom", type=word("box", "cylinder", "ellipsoid"), density=number(100, 900), pos=vector()),
    *_right(
        "turn geom", shellinertia=word("true"), friction=number(0.2, 0.7), contype=word("0"), margin=number(0, 0.1)
    ),
    *_of_scalar("slide"),
    *_right("slide", **{"class": word("own")}),
    *_right("slide geom", type=word("box"), size=vector(3, 0.03, 0.2), axisangle=direction(4), conaffinity=word("0")),
    *_right("slide geom", contype=word("0")),
    *_right("two geom", fromto=vector(6), mass=number(1, 3)),
    *_right("ball", pos=vector(), stiffness=number(1, 5), damping=number(0.5, 2), armature=number(0.1, 1)),
    *_right("ball geom", size=vector(3, 0.05, 0.2), xyaxes=square_axes, density=number(100, 900)),
    *_right("mesh geom", pos=vector(), mass=number(1, 2), zaxis=direction()),
    *_right("group geom", group=word("3", "4"), type=word("box"), size=vector(3, 0.05, 0.1), gap=number(0.01, 0.1)),
    *_frames("weighed body", "quat"),
    *_right("inertial", pos=vector(), quat=direction(4), mass=number(0.5, 3), diaginertia=vector(3, 0.1, 0.19)),
    *_right("full", pos=vector(), mass=number(0.5, 3), fullinertia=bent_tensor),
    *_frames("by axis", "axisangle"),
    *_frames("by xy", "xyaxes"),
    *_frames("by z", "zaxis"),
    *_frames("frame", "euler"),
    *_frames("by axis geom", "axisangle"),
    *_frames("by xy geom", "xyaxes"),
    *_frames("by z geom", "zaxis"),
    *_frames("by euler geom", "euler"),
    *_right("hang", range=numbers((-0.7, -0.2), (2, 3)), margin=number(0.001, 0.003), **{"class": word("own")}),
    *_right("drop", range=numbers((-0.7, -0.2), (0.2, 3)), margin=number(0.01, 0.1), damping=number(1, 3)),
    *_right("hang", solreflimit=SOFTNESS["solref"], solimplimit=SOFTNESS["solimp"]),
    *_right("drop", solreflimit=numbers((-900, -300), (-40, -10)), solimplimit=SOFTNESS["solimp"]),
    *_right("drop", actuatorfrcrange=word("-2 2", "-3 3")),
    *_right("full joint", actuatorfrcrange=numbers((-0.3, -0.1), (0.1, 0.2))),
    *_right("tied", limited=word("false"), range=numbers((-0.5, -0.2), (0.2, 0.5))),
    *_right("floor", friction=number(1.2, 2), priority=word("3"), contype=word("2"), condim=word("1")),
    *_right("tool", pos=vector(), quat=direction(4)),
    *_right("by fromto", fromto=vector(6), size=word(".01")),
    *_right("by euler", pos=vector(), euler=vector(3, -2, 2)),
    *_right("connect", anchor=vector(), body2=word("tied", "trunk")),
    *_right("connect sites", site1=word("by_fromto")),
    *_right("weld", relpose=numbers(*[(-0.3, 0.3)] * 3, *[(0.3, 1)] * 4), torquescale=word("0"), anchor=vector()),
    *_right("coupling", polycoef=numbers((-1, 1), (2, 3)), joint2=word("slide", "turn")),
    *_right("tie", polycoef=numbers((-1, 1))),
    *_right("of turn", coef=number(2, 3)),
    *_right("motor", gear=number(2, 9), ctrlrange=numbers((-0.5, -0.1), (0.1, 0.5)), armature=number(0.1, 1)),
    *_right("motor", damping=number(0.1, 1), forcerange=numbers((-0.3, -0.1), (0.1, 0.3))),
    *_right("pull", gear=number(2, 9), ctrlrange=numbers((-0.5, -0.1), (0.1, 0.5))),
    *_right("servo", kp=number(3, 9), kv=number(0.5, 3), gear=number(-3, -1.5), forcerange=numbers((-1, 0), (0, 1))),
    *_right("ranged", inheritrange=number(0.5, 0.9), dampratio=number(0.5, 2)),
    *_right(
        "speed", kv=number(2, 9), gear=number(2, 3), ctrllimited=word("false"), ctrlrange=numbers((-0.3, 0), (0, 1))
    ),
    *_right("any", **GAINS, gear=number(2, 3), gaintype=word("affine"), biastype=word("none")),
    *_right("any", forcelimited=word("false"), forcerange=numbers((-0.3, -0.1), (0.1, 0.3))),
    *_right("dc", motorconst=number(2, 3), resistance=number(2, 3)),
    *_right("key", qpos=numbers(*QPOS), qvel=numbers(*QVEL), ctrl=vector(7, -1, 1)),
]


def _warned(element, words, **draws):
    return [Attribute(element, name, draw, "warned", words) for name, draw in draws.items()]


def _refused(element, words, *needs, **draws):
    return [Attribute(element, name, draw, "refused", words, needs) for name, draw in draws.items()]


FRICTION = r"the softness \(solreffriction, solimpfriction\) of the friction of (joint '\w+', )*joint"
BY_FRICTION = {"solreffriction": SOFTNESS["solref"], "solimpfriction": SOFTNESS["solimp"]}
WARNED = [
    *_warned("option", "the forces of actuator 'motor'", actuatorgroupdisable=word("0", "0 1")),
    *_warned("flag", "the forces of actuator 'motor'", actuation=word("disable")),
    *_warned("flag", "equality 'weld', which is not active", equality=word("disable"), constraint=word("disable")),
    *_warned("mocap", "the motion of mocap body 'mocap'", mocap=word("true")),
    *_warned("floor", "geom", solref=SOFTNESS["solref"], solimp=SOFTNESS["solimp"]),
    *_warned("floor", "surfacevel.* of|all contacts, which", surfacevel=vector()),
    *_warned("floor", "adhesion.* of|all contacts, which", adhesion=number(1, 5)),
]
for key in ("connect", "connect sites", "weld", "coupling", "tie"):
    name = key.replace(" ", "_")
    WARNED += _warned(key, f"equality '{name}', which is not active", active=word("false"))
    WARNED += _warned(key, f"{SOFT} '{name}'", **SOFTNESS)
for key in ("turn", "slide"):
    WARNED += [
        Attribute(key, name, draw, "warned", f"{FRICTION} '{key}'", ((key, "frictionloss", "1"),))
        for name, draw in BY_FRICTION.items()
    ]
REFUSED = [
    *_refused("option", "fluid forces", density=number(1, 2), viscosity=number(0.1, 1)),
    *_refused(
        "turn",
        "joint 'turn', which has actuatorgravcomp",
        ("ball body", "gravcomp", "1"),
        actuatorgravcomp=word("true"),
    ),
    *_refused("turn", "joint 'turn', which has polynomial stiffness", stiffness=numbers((1, 2), (0, 0), (1, 2))),
    *_refused("slide", "joint 'slide', which has polynomial damping", damping=numbers((1, 2), (1, 2))),
    *_refused("turn", "joint 'turn', which has plasticity", ("turn", "stiffness", "1"), springyield=number(0.1, 1)),
    *_refused("ball", "a ball joint with a limited range", range=numbers((0, 0), (0.5, 1))),
    *_refused("ball", "a ball joint with frictionloss", frictionloss=number(1, 2)),
    *_refused("root", "a free joint with frictionloss", frictionloss=number(1, 2)),
    *_refused("sum", "tendon 'sum', which has stiffness", stiffness=number(1, 2)),
    *_refused("sum", "tendon 'sum', which has damping", damping=number(1, 2)),
    *_refused("sum", "tendon 'sum', which has armature", armature=number(1, 2)),
    *_refused("sum", "tendon 'sum', which has frictionloss", frictionloss=number(1, 2)),
    *_refused("sum", "tendon 'sum', which has a limited", range=numbers((-1, 0), (0.5, 1))),
    *_refused("sum", "tendon 'sum', which has actuatorfrcrange", actuatorfrcrange=numbers((-1, 0), (0.5, 1))),
    *_refused(
        "coupling", "equality 'coupling', a polynomial", polycoef=numbers((0, 1), (1, 2), (1, 2), (0, 1), (0, 1))
    ),
    *_refused("servo", "actuator 'servo', which has an activation", timeconst=number(0.1, 1)),
    *_refused("any", "actuator 'any', which has an activation", dyntype=word("filter", "integrator", "filterexact")),
    *_refused("any", "actuator 'any', whose gain depends", ("any", "gaintype", "affine"), gainprm=vector(3, 1, 2)),
    *_refused("motor", "actuator 'motor', which has a", ("motor", "nsample", "9"), delay=number(0.01, 0.02)),
    *_refused("motor", "actuator 'motor', which has a history", nsample=word("5", "9")),
    *_refused("pull", "armature on a tendon", armature=number(0.1, 1)),
    *_refused("pull", "damping on a tendon", damping=number(0.1, 1)),
    *_refused("drop", "joint 'drop', which has a margin of", margin=number(2, 3)),
    *_refused("dc", "actuator 'dc', a DC motor with", cogging=vector(3, 1, 2), inductance=numbers((0.1, 1), (0.1, 1))),
]
ATTRIBUTES = [*RIGHT, *WARNED, *REFUSED]


def text(rng, chosen):
    """Return the text of a file with some of ``ATTRIBUTES``, of values that a generator draws."""
    of = {key: {"tag": tag, **always} for key, (tag, always) in ELEMENTS.items()}
    for attribute in chosen:
        for element, name, value in attribute.needs:
            of[element][name] = value
        _put(of[attribute.element], attribute.name, attribute.draw(rng))
    parts = {key: " ".join([one.pop("tag"), *(f'{k}="{v}"' for k, v in one.items() if v)]) for key, one in of.items()}
    return FILE.format(**parts)


def _put(element, name, value):
    """Write an attribute in place of those that say the same in another way."""
    if name in ("fullinertia",):
        element.pop("diaginertia", None)
    element[name] = value


HIDING = {  # switches by (element, name): words of the attributes that say nothing beside them
    ("flag", "constraint"): ("softness", "geom"),
    ("flag", "equality"): (SOFT,),
    ("flag", "frictionloss"): (FRICTION,),
    ("flag", "contact"): ("geom",),
}
HIDING |= {
    (one.element, "active"): (f"{SOFT} '{one.element.replace(' ', '_')}'",) for one in WARNED if one.name == "active"
}


def random_files(seed, files):
    """Yield a generator and a choice of attributes for each of some files. Each of ``RIGHT`` and ``WARNED`` is in half
    of them, less where a switch takes its meaning; switches that do are in a quarter."""
    rng = np.random.default_rng(seed)
    some = [*RIGHT, *WARNED]
    shares = [4 if (one.element, one.name) in HIDING else 2 for one in some]
    inside = np.array([rng.permutation(files) < -(-files // share) for share in shares])
    for file in range(files):
        chosen = [one for one, within in zip(some, inside[:, file], strict=True) if within]
        hidden = [words for one in chosen for words in HIDING.get((one.element, one.name), ())]
        yield (
            rng,
            [one for one in chosen if not any(one.words.startswith(w) or f"the {w}" in one.words for w in hidden)],
        )
