"""Random MJCF: bodies with up to three joints of any kind, in any order and each with its own anchor."""

import numpy as np


def _joint_types(rng, root):
    """Return the types of a body's joints, in order; a ball is the last that turns, as MuJoCo wants."""
    if root and rng.random() < 0.5:
        return ["free"]
    kinds = rng.choice(["hinge", "slide", "hinge", "slide", "ball"], size=rng.integers(0, 4)).tolist()
    ball = kinds.index("ball") if "ball" in kinds else len(kinds)
    return kinds[: ball + 1] + [kind for kind in kinds[ball + 1 :] if kind == "slide"]


def random_mjcf(seed, bodies=10):
    """Return the text of a model: a forest with static and free roots, ``ref``, springs, armature and gravcomp."""
    rng = np.random.default_rng(seed)
    numbers = lambda values: " ".join(f"{x:.17g}" for x in np.atleast_1d(values))  # noqa: E731
    vector = lambda size=3, scale=0.3: numbers(rng.normal(size=size) * scale)  # noqa: E731
    parents = [int(rng.integers(-1, k)) for k in range(bodies)]
    texts = []
    for k in range(bodies):
        inertia = rng.uniform(0.01, 0.019, 3)
        joints = []
        for i, kind in enumerate(_joint_types(rng, parents[k] < 0)):
            scalar = kind in ("hinge", "slide")
            more = f'axis="{vector()}" ref="{rng.normal():.17g}" springref="{rng.normal():.17g}"' if scalar else ""
            more += f' pos="{vector()}"' if kind != "free" else ""
            more += f' stiffness="{rng.uniform(0, 5)}" damping="{rng.uniform(0, 2)}" armature="{rng.uniform(0, 0.1)}"'
            joints.append(f'<joint name="j{k}_{i}" type="{kind}" {more}/>')
        texts.append(
            f'<body name="b{k}" pos="{vector()}" quat="{vector(4, 1.0)}" gravcomp="{rng.choice([0, 0, 0.7])}">'
            f'<inertial pos="{vector()}" quat="{vector(4, 1.0)}" mass="{rng.uniform(0.5, 2):.17g}" '
            f'diaginertia="{numbers(inertia)}"/>{"".join(joints)}<site name="s{k}" pos="{vector()}" '
            f'quat="{vector(4, 1.0)}"/>'
        )

    def nested(parent):
        return "".join(texts[k] + nested(k) + "</body>" for k in range(bodies) if parents[k] == parent)

    option = f'<compiler angle="radian"/><option gravity="{vector(scale=10)}"/>'
    return f"<mujoco>{option}<worldbody>{nested(-1)}</worldbody></mujoco>"
