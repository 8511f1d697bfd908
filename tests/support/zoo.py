"""Hand-made scenes for tests: deterministic, small, and awkward where robots are kind.

Random scenes have rotated and offset anchors on both sides, off-centre CoMs, full inertias that obey the triangle
inequality, and armature. Their float64 values come from seeded generators, so a failure can be run again.
"""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np

from warp_spo.scene.parts import KINDS, Body, Coupling, Hinge, Loop
from warp_spo.scene.scene import Scene

INNER_KINDS = ("fixed", "revolute", "prismatic", "helical", "universal", "cylindrical", "ball", "planar", "free", "d6")
SCREW_KINDS = ("revolute", "prismatic", "universal", "cylindrical", "d6")
assert set(INNER_KINDS) == set(KINDS), "a hinge kind is missing from the zoo"


def unit(rng, *shape):
    """Random unit vectors (*shape), uniform on the sphere."""
    vector = rng.normal(size=shape)
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def random_pose(rng, reach=0.4):
    """A pose (7,) with an offset of up to ``reach`` [m] a coordinate and any rotation."""
    return np.concatenate([rng.uniform(-reach, reach, 3), unit(rng, 4)])


def random_body(rng, label=""):
    """A body of 0.5 to 2 kg whose CoM is off the body frame's origin and whose inertia has no zero entry."""
    root = rng.uniform(-0.25, 0.25, (3, 3)) + 0.2 * np.eye(3)
    spread = root @ root.T  # second moments of mass per kg
    mass = rng.uniform(0.5, 2.0)
    inertia = mass * (np.trace(spread) * np.eye(3) - spread)
    return Body(mass, rng.uniform(-0.2, 0.2, 3), 0.5 * (inertia + inertia.T), label=label)


def random_hinge(rng, kind, parent, child, axes=None, plain=False):
    """A hinge with random axes and anchors.

    Args:
        axes: of a d6: (translations, rotations); drawn if None.
        plain: anchors coincide with the body frames, no armature, damping and stiffness.
    """
    arguments = {}
    if kind in ("revolute", "prismatic", "helical", "cylindrical", "planar"):
        arguments["axis"] = unit(rng, 3)
    if kind == "helical":
        arguments["pitch"] = rng.uniform(0.05, 0.3)
    if kind == "universal":
        arguments["axis"] = unit(rng, 2, 3)
    if kind == "d6":
        if axes is None:
            axes = rng.integers(0, 4, 2)
            axes[rng.integers(2)] += not axes.any()
        basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        arguments["linear"] = basis[: axes[0]]
        arguments["angular"] = np.linalg.qr(rng.normal(size=(3, 3)))[0][: axes[1]]
    if not plain:
        dof = Hinge(kind, parent, child, **arguments).dof_count
        arguments |= dict(
            parent_pose=random_pose(rng),
            child_pose=random_pose(rng, 0.2),
            armature=rng.uniform(0.01, 0.2, dof),
            damping=rng.uniform(0.0, 1.0, dof),
            stiffness=rng.uniform(0.0, 5.0, dof),
        )
    return Hinge(kind, parent, child, **arguments)


def single_body(kind="free", seed=0):
    """One body on one hinge of a kind."""
    rng = np.random.default_rng(seed)
    return Scene([random_body(rng)], [random_hinge(rng, kind, -1, 0)], gravity=rng.uniform(-9.81, 9.81, 3))


def from_parents(parents, kinds, seed, hinge_order=None, d6_axes=()):
    """A random scene over a given tree; ``kinds[k]`` carries body k."""
    rng = np.random.default_rng(seed)
    axes = list(d6_axes)
    bodies = [random_body(rng) for _ in parents]
    hinges = [
        random_hinge(rng, kind, int(parent), k, axes=axes.pop() if kind == "d6" and axes else None)
        for k, (parent, kind) in enumerate(zip(parents, kinds, strict=True))
    ]
    order = range(len(hinges)) if hinge_order is None else hinge_order
    return Scene(bodies, [hinges[i] for i in order], gravity=rng.uniform(-9.81, 9.81, 3))


def chain(n, kind="revolute", seed=1):
    """A serial chain on a fixed base, body 0 at the base."""
    return from_parents(np.arange(n) - 1, [kind] * n, seed)


def fork(seed=2):
    """A floating body with two arms of two revolute bodies, one of them numbered before it."""
    kinds = ["revolute", "revolute", "free", "revolute", "universal"]
    return from_parents([2, 0, -1, 2, 3], kinds, seed, [4, 2, 0, 3, 1])


def dancer():
    """A floating pelvis with two legs and a waist, on it two arms of two fingers each: limbs that part again."""
    kinds = ["free", "revolute", "revolute", "prismatic"] + ["revolute", "universal", "revolute"] * 2
    return from_parents([-1, 0, 0, 0, 3, 4, 4, 3, 7, 7], kinds, 58)


def forest(seed=3):
    """Two robots in one scene, interleaved: a floating one and one on a fixed base with a fixed and a ball hinge."""
    parents = [-1, -1, 0, 1, 2, 3, 2]
    return from_parents(parents, ["free", "revolute", "revolute", "fixed", "d6", "ball", "prismatic"], seed)


def star(n, seed=4):
    """A floating root with n children that have none."""
    return from_parents([-1] + [0] * n, ["free"] + ["revolute"] * n, seed)


def random_tree(n, seed, kinds=INNER_KINDS, roots=1, root_kind="free"):
    """A random tree of n bodies: any numbering, any order of the hinges, hinge kinds dealt out in turn.

    One root hinge is a ``root_kind``; more than len(kinds) bodies have every kind, free ones also inside the tree.
    """
    rng = np.random.default_rng(seed)
    parents = np.array([-1 if k < roots else rng.integers(max(0, k - 4), k) for k in range(n)])
    dealt = [kinds[i % len(kinds)] for i in range(n)]
    rng.shuffle(dealt)
    dealt[0] = root_kind
    number = rng.permutation(n)
    renamed, renamed_kinds = np.empty(n, dtype=int), [""] * n
    for k in range(n):
        renamed[number[k]] = -1 if parents[k] < 0 else number[parents[k]]
        renamed_kinds[number[k]] = dealt[k]
    return from_parents(renamed, renamed_kinds, seed + 1000, rng.permutation(n))


def every_d6(seed=5):
    """A fixed-base chain of d6 hinges with 1 to 6 axes, and one with none."""
    axes = [(0, 0), (1, 0), (0, 1), (2, 0), (0, 2), (3, 0), (0, 3), (1, 1), (2, 3), (3, 3)]
    return from_parents(np.arange(len(axes)) - 1, ["d6"] * len(axes), seed, d6_axes=axes[::-1])


def plain(n=6, seed=6):
    """A revolute tree whose anchors are the body frames: structural zeros everywhere, no armature."""
    rng = np.random.default_rng(seed)
    hinges = [
        Hinge("revolute", (k - 1) // 2, k, axis=np.eye(3)[k % 3], parent_pose=(0.3 * (k > 0), 0, 0, 0, 0, 0, 1))
        for k in range(n)
    ]
    return Scene([random_body(rng) for _ in range(n)], hinges)


# -- closed forms, and the stress suite's base chain ------------------------------------------------------------------
def rod(mass, length, thin=True):
    """A uniform rod along +x from the body frame's origin; ``thin``: no inertia about its own axis."""
    inertia = mass * length**2 / 12.0
    return Body(mass, (0.5 * length, 0.0, 0.0), np.diag([0.0 if thin else 0.01, inertia, inertia]))


def planar_chain(n, mass=1.0, length=1.0, gravity=(0.0, -9.81, 0.0)):
    """n equal thin rods in the xy plane, hinges about z; straight along x at q = 0."""
    hinges = [
        Hinge("revolute", k - 1, k, axis=(0, 0, 1), parent_pose=(length * (k > 0), 0, 0, 0, 0, 0, 1)) for k in range(n)
    ]
    return Scene([rod(mass, length) for _ in range(n)], hinges, gravity=gravity)


def double_pendulum(mass=1.3, length=0.7):
    """O1: two uniform rods, q from the x axis, gravity 9.81 along -y."""
    return planar_chain(2, mass, length)


def cart_pole(cart=2.0, bob=0.5, length=0.8):
    """O4: a cart that slides along x and a point mass on a massless pole that hangs along -y at q = 0."""
    bodies = [Body(cart), Body(bob, (0.0, -length, 0.0))]
    hinges = [Hinge("prismatic", -1, 0, axis=(1, 0, 0)), Hinge("revolute", 0, 1, axis=(0, 0, 1))]
    return Scene(bodies, hinges, gravity=(0.0, -9.81, 0.0))


def rod_chain(n):
    """The base chain: rods L = 1 m, m = 1 kg, Ic = diag(.01, 1/12, 1/12), axes alternately z and y.

    Returns:
        scene; q [n] uniform in (-0.6, 0.6) of seed 2; tau [n] normal of seed 3.
    """
    hinges = [
        Hinge("revolute", k - 1, k, axis=(0, k % 2, 1 - k % 2), parent_pose=(k > 0, 0, 0, 0, 0, 0, 1)) for k in range(n)
    ]
    scene = Scene([rod(1.0, 1.0, thin=False) for _ in range(n)], hinges)
    return scene, np.random.default_rng(2).uniform(-0.6, 0.6, n), np.random.default_rng(3).normal(size=n)


# -- the same scene, otherwise -----------------------------------------------------------------------------------------
class Permuted(NamedTuple):
    """A renumbered scene, and where its parts come from: new[i] = old[map[i]] for each map."""

    scene: Scene
    body: np.ndarray  # [body]
    hinge: np.ndarray  # [hinge]
    q: np.ndarray  # [coordinate]
    qd: np.ndarray  # [dof]


def permuted(scene, seed=0):
    """``scene`` with its bodies renumbered and its hinges reordered at random, values of all worlds included."""
    rng = np.random.default_rng(seed)
    body, hinge = rng.permutation(scene.body_count), rng.permutation(len(scene.hinges))
    new_body, new_hinge = np.argsort(body), np.argsort(hinge)  # new number of an old one
    node = lambda k: -1 if k < 0 else int(new_body[k])  # noqa: E731

    def renumbered(edge, kind):
        fields = {f: getattr(edge, f) for f in kind.__dataclass_fields__ if kind.__dataclass_fields__[f].init}
        fields |= dict(parent=node(edge.parent), child=node(edge.child), axis=None, linear=None, angular=None)
        fields["pitch"] = 0.0
        moved = {"d6": dict(linear=edge.linear, angular=edge.angular)}.get(edge.kind, dict(axis=edge.axis))
        if edge.kind == "helical":
            moved["pitch"] = edge.pitch
        return kind(**(fields | moved))

    coupled = [
        Coupling(int(new_hinge[c.hinge]), int(new_hinge[c.reference]), c.ratio, c.offset) for c in scene.couplings
    ]
    actuators = [dataclasses.replace(a, hinges=[int(new_hinge[h]) for h in a.hinges]) for a in scene.actuators]
    new = Scene(
        [scene.bodies[k] for k in body],
        [renumbered(scene.hinges[h], Hinge) for h in hinge],
        gravity=scene.values["gravity"][0],
        loops=[renumbered(loop, Loop) for loop in scene.loops],
        couplings=coupled,
        actuators=actuators,
    )
    entries = lambda start: np.concatenate([np.arange(start[h], start[h + 1]) for h in hinge]).astype(int)  # noqa: E731
    q, qd = entries(scene.q_start), entries(scene.qd_start)
    values = {}
    for name, array in scene.values.items():
        by_dof = name not in ("gravity", "joint_X_p", "joint_X_c", "joint_rest_q") and name.startswith("joint")
        if name.startswith(("actuator", "contact", "ground")):
            continue  # of actuators, contacts and the ground, whose order stays
        rows = {"gravity": slice(None), "joint_X_p": hinge, "joint_X_c": hinge, "joint_rest_q": q}
        values[name] = array[:, qd if by_dof else rows.get(name, body)]
    return Permuted(new.with_values(**values), body, hinge, q, qd)


BRANCHED = [(10, 1, 10), (60, 1, 30), (14, 2, 5), (18, 3, 4), (22, 1, 6), (27, 2, 12), (33, 1, 30), (40, 3, 8),
            (48, 2, 20), (54, 1, 15)]  # fmt: skip
"""Ten random trees: dofs at least, roots, levels at most."""
SERIAL = ("revolute", "revolute", "revolute", "prismatic", "universal", "ball", "cylindrical", "fixed", "planar")


def branched(which):
    """One of BRANCHED; branches where chance has it; one root in two floats."""
    dofs, roots, levels = BRANCHED[which]
    rng = np.random.default_rng(1000 + which)
    parents, kinds, level, count = [], [], [], 0
    while count < dofs or len(parents) < roots:
        k = len(parents)
        below = [p for p in range(k) if level[p] < levels]
        straight = k > 0 and level[-1] < levels and rng.uniform() < (0.9 if levels > 10 else 0.6)
        parents.append(-1 if k < roots else k - 1 if straight else int(rng.choice(below)))
        kinds.append(str(rng.choice(SERIAL)) if parents[-1] >= 0 or k % 2 else "free")
        level.append(1 if parents[-1] < 0 else level[parents[-1]] + 1)
        count += random_hinge(rng, kinds[-1], -1, 0).dof_count
    return from_parents(parents, kinds, 2000 + which)


def varied(scene, worlds, seed=0):
    """``scene`` with masses, CoMs, inertias, anchors, armature and gravity that differ from world to world."""
    rng = np.random.default_rng(seed)
    v = {name: np.repeat(array[:1], worlds, axis=0) for name, array in scene.values.items()}
    scale = rng.uniform(0.7, 1.4, (worlds, scene.body_count))
    v["body_mass"] *= scale
    v["body_inertia"] *= scale[..., None, None]
    v["body_com"] += rng.uniform(-0.05, 0.05, v["body_com"].shape)
    v["joint_armature"] += rng.uniform(0.0, 0.1, v["joint_armature"].shape)
    v["gravity"] += rng.uniform(-1.0, 1.0, v["gravity"].shape)
    for name in ("joint_X_p", "joint_X_c"):
        v[name] += rng.uniform(-0.05, 0.05, v[name].shape)
        v[name][..., 3:] /= np.linalg.norm(v[name][..., 3:], axis=-1, keepdims=True)
    names = ("body_mass", "body_inertia", "body_com", "joint_armature", "gravity", "joint_X_p", "joint_X_c")
    return scene.with_values(**{name: v[name] for name in names})


class State(NamedTuple):
    """q [worlds, coordinate], qd and tau [worlds, dof], float64."""

    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray


def random_state(scene, worlds=1, seed=0):
    """States that differ from world to world: q in (-1.2, 1.2) [rad, m], any rotation, qd and tau normal."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.2, 1.2, (worlds, scene.coord_count))
    for hinge, start in zip(scene.hinges, scene.q_start, strict=False):
        if hinge.kind in ("ball", "free"):
            end = start + hinge.coord_count
            q[:, end - 4 : end] = unit(rng, worlds, 4)
    return State(q, *rng.normal(size=(2, worlds, scene.dof_count)))


SCENES = {
    f"one_{kind}": functools.partial(single_body, kind, seed=10 + i) for i, kind in enumerate(KINDS) if kind != "fixed"
}
SCENES |= {
    "one_fixed_then_revolute": functools.partial(from_parents, [-1, 0, 1], ["fixed", "revolute", "fixed"], 9),
    "chain7": functools.partial(chain, 7),
    "chain_ball": functools.partial(chain, 3, "ball"),
    "chain_helical": functools.partial(chain, 4, "helical"),
    "chain_universal": functools.partial(chain, 3, "universal"),
    "chain_cylindrical": functools.partial(chain, 3, "cylindrical"),
    "chain_planar": functools.partial(chain, 3, "planar"),
    "chain_free": functools.partial(chain, 3, "free"),
    "every_d6": every_d6,
    "fork": fork,
    "dancer": dancer,
    "forest": forest,
    "star": functools.partial(star, 6),
    "plain": plain,
    "rods": lambda: rod_chain(8)[0],
    "screw_tree": functools.partial(random_tree, 12, 21, SCREW_KINDS, root_kind="universal"),
    "floating_tree": functools.partial(random_tree, 14, 22, ("revolute", "ball", "fixed", "prismatic", "planar")),
    "tree10": functools.partial(random_tree, 10, 23),
    "tree20": functools.partial(random_tree, 20, 24),
    "trees25": functools.partial(random_tree, 25, 25, roots=3),
}
"""Name -> scene factory without arguments."""

FEW = ("one_fixed_then_revolute", "chain_free", "chain_helical", "every_d6", "fork", "forest", "plain", "tree10")
"""Scenes that a quick run takes where a law holds for all of them: every kind of hinge, free hinges within a tree,
limbs, several roots, fixed bodies, anchors that coincide with body frames."""
