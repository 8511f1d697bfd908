"""Scenes from a finalized ``newton.Model``.

Newton keeps all worlds in flat float32 arrays. :func:`from_newton` finds the rows of each world, checks that all worlds
have one topology, and copies world 0 into a :class:`Scene`; values that differ between worlds stay one per world.
Nothing is assumed about the order of bodies and joints: a body's hinge is found through ``joint_child``.
"""

from __future__ import annotations

import warnings
from typing import Any

import newton
import numpy as np
from newton import JointType

from ..errors import DirectedLoopError, UnsupportedError
from ..scene.parts import DOF_VALUES, UNLIMITED, Body, Coupling, Hinge, Loop
from ..scene.scene import Scene

KINDS = {
    JointType.FIXED: "fixed",
    JointType.PRISMATIC: "prismatic",
    JointType.REVOLUTE: "revolute",
    JointType.BALL: "ball",
    JointType.FREE: "free",
    JointType.DISTANCE: "distance",
    JointType.D6: "d6",
}
ROUNDING = 1e-3  # relative: a quaternion or axis nearer than this to unit length is a rounded unit vector
ASYMMETRY = 1e-6  # relative: R I R^T in float32 leaves a few 1e-7
OBLIQUE = 1e-3  # cosine: D6 axes nearer than this to a right angle are orthogonal up to a file's digits


def from_newton(model: newton.Model) -> Scene:
    """The scene of a finalized model.

    Bodies keep the model's order within a world, hinges that of the model's tree joints; labels are those of world 0,
    without the world's prefix. A joint outside every articulation is a tree joint if it alone carries its child, else
    a :class:`Loop`; a disabled loop joint is left out. A mimic becomes a :class:`Coupling`. A DISTANCE joint becomes a
    free hinge, with a warning if it limits a distance.

    ``scene.q_index`` and ``scene.dof_index``, [worlds, n], say which entries of the model's joint_q and joint_qd the
    scene's q and qd are. Values that all worlds share have shape [1, ...], others [worlds, ...]. Quaternions and axes
    are normalised in float64, an inertia that is symmetric up to float32 rounding is made symmetric.

    A model does not tell whether ``finalize`` repaired an inertia: heed its warning (:func:`load` names the bodies).

    Raises:
        TypeError: not a Newton model.
        UnsupportedError: worlds that differ in more than values, naming the first world and what differs in it; global
            bodies beside worlds; bodies without a joint; kinematic bodies that can move; ROD joints; disabled tree
            joints; joints that leave their articulation or world; D6 joints with oblique angular axes; tendons;
            MuJoCo equality constraints without a Newton counterpart.
        DirectedLoopError: joints outside every articulation that carry each other in a circle.
        ValueError: values that no scene has.
    """
    if not isinstance(model, newton.Model):
        raise TypeError(f"from_newton: got {type(model).__name__}; expected newton.Model, from ModelBuilder.finalize()")
    _refuse_what_no_scene_holds(model)
    worlds = Worlds(model)
    worlds.check_equal()

    # Flat entries of q and qd that each world's hinges own.
    q_index, dof_index = _entries(worlds.q_start, worlds.hinges), _entries(worlds.qd_start, worlds.hinges)

    read = lambda name, rows: host(model, name)[rows].astype(np.float64)  # noqa: E731
    values = {name: read(name, worlds.bodies) for name in ("body_mass", "body_com", "body_inertia")}
    values["body_inertia"] = _symmetric(values["body_inertia"])
    values |= {name: _unit_pose(read(name, worlds.hinges)) for name in ("joint_X_p", "joint_X_c")}
    values |= {name: read(name, dof_index) for name in DOF_VALUES}
    for name in ("joint_limit_lower", "joint_limit_upper", "joint_effort_limit", "joint_velocity_limit"):
        values[name] = values[name].clip(-UNLIMITED, UNLIMITED)  # USD files give infinities
    values["joint_rest_q"] = read("joint_rest_q", q_index)
    gravity = host(model, "gravity").astype(np.float64) + 0.0  # no -0.0
    values["gravity"] = gravity[: worlds.count] if worlds.declared else gravity[-1:]  # last: bodies outside worlds

    body_labels = worlds.labels(model.body_label, worlds.bodies)
    bodies = [
        Body(values["body_mass"][0, k], values["body_com"][0, k], values["body_inertia"][0, k], label=label)
        for k, label in enumerate(body_labels)
    ]
    hinges, q, dof = [], slice(0, 0), slice(0, 0)
    for joint, label in zip(worlds.hinges[0], worlds.labels(model.joint_label, worlds.hinges), strict=True):
        q = slice(q.stop, q.stop + np.diff(worlds.q_start)[joint])
        dof = slice(dof.stop, dof.stop + np.diff(worlds.qd_start)[joint])
        kind = worlds.type[joint]
        if kind == JointType.DISTANCE:
            _drop_distance_limits(label, values, dof)
        if kind in (JointType.BALL, JointType.FREE, JointType.DISTANCE):
            turn = slice(q.stop - 4, q.stop)
            values["joint_rest_q"][:, turn] = _unit_or_identity(values["joint_rest_q"][:, turn])
        per_dof: dict[str, Any] = {name.removeprefix("joint_"): values[name][0, dof] for name in DOF_VALUES}
        hinges.append(Hinge(**worlds.edge(joint), rest=values["joint_rest_q"][0, q], label=label, **per_dof))
    loop_labels = worlds.labels(model.joint_label, worlds.loops)
    loops = [Loop(**worlds.edge(joint), label=label) for joint, label in zip(worlds.loops[0], loop_labels, strict=True)]
    couplings = [Coupling(int(h), int(r), ratio=float(c[1]), offset=float(c[0])) for h, r, c in worlds.couplings()]

    try:
        scene = Scene(bodies, hinges, values["gravity"][0], loops, couplings)
    except DirectedLoopError as error:
        names = names_of([body_labels[body] for body in error.cycle])
        raise DirectedLoopError(f"from_newton, the joints of bodies {names}", error.cycle) from None
    differing = {name: array for name, array in values.items() if (array != array[:1]).any()}
    scene = scene.with_values(**differing)
    scene.q_index, scene.dof_index = q_index, dof_index
    return scene


def _refuse_what_no_scene_holds(model: newton.Model) -> None:
    def refuse(what: str, labels: list[str], way_out: str) -> None:
        raise UnsupportedError("from_newton", f"{what} {names_of(labels)}".rstrip(), way_out)

    if model.tendon_count:
        refuse("a model with tendons:", list(model.tendon_label), "build it without them")
    mujoco: Any = getattr(model, "mujoco", None)
    if model.custom_frequency_counts.get("mujoco:tendon", 0):
        labels = [str(label) for label in getattr(mujoco, "tendon_label", [])]
        refuse("a model with MuJoCo tendons (model.mujoco.tendon_*):", labels, "remove <tendon> from the file")
    if model.custom_frequency_counts.get("mujoco:equality_constraint", 0):
        # target_kind 0: no loop joint and no mimic stands for the row
        lost = (host(mujoco, "equality_constraint_target_kind") == 0) & host(mujoco, "equality_constraint_enabled")
        labels = [str(mujoco.equality_constraint_label[row]) for row in np.flatnonzero(lost)]
        if labels:
            refuse(
                "a MuJoCo equality constraint that is neither a loop joint nor a mimic:",
                labels,
                "import with convert_mjc_equality_constraints=True, or remove it from the file",
            )
    if model.joint_count:
        for joint, kind in enumerate(host(model, "joint_type")):
            if kind not in KINDS:
                refuse(
                    f"a {JointType(kind).name} joint:",
                    [model.joint_label[joint]],
                    f"use another joint: {', '.join(kind.name for kind in KINDS)}",
                )


class Worlds:
    """Rows of a model's flat arrays by world: ``bodies``, ``hinges`` and ``loops``, each [world, n]."""

    def __init__(self, model: newton.Model):
        if model.body_count == 0:
            raise ValueError("from_newton: the model has no bodies; expected one or more")
        self.model = model
        read = lambda name: host(model, f"joint_{name}") if model.joint_count else np.zeros(0, dtype=int)  # noqa: E731
        self.type, self.parent, self.child = read("type"), read("parent"), read("child")
        self.articulation, self.enabled = read("articulation"), read("enabled").astype(bool)
        self.dof_dim, self.X_p, self.X_c = read("dof_dim"), read("X_p"), read("X_c")
        self.q_start, self.qd_start = read("q_start"), read("qd_start")
        self.axis = host(model, "joint_axis") if model.joint_dof_count else np.zeros((0, 3))
        body_world = self._world_of_bodies()
        joint_world = body_world[self.child]
        is_hinge = self._carries()
        self._check_joints(is_hinge, body_world)
        is_loop = ~is_hinge & self.enabled

        # Counts first: from the first world with another count on, rows cannot be compared.
        self.limit, self.what = self.count, ""
        self.mimics = self._mimics()
        groups = {
            "bodies": (body_world, np.arange(model.body_count)),
            "joints": (joint_world[is_hinge], np.flatnonzero(is_hinge)),
            "loop joints": (joint_world[is_loop], np.flatnonzero(is_loop)),
            "mimics": (joint_world[self.mimics[0]], np.arange(len(self.mimics[0]))),
        }
        for name, (world, _) in groups.items():
            counts = np.bincount(world, minlength=self.count)
            others = np.flatnonzero(counts != counts[0])
            if len(others) and others[0] < self.limit:
                self.limit = others[0]
                self.what = f"it has {counts[self.limit]} {name} where world 0 has {counts[0]}"
        self.bodies, self.hinges, self.loops, self.mimic_rows = (
            rows[np.argsort(world, kind="stable")][: self.limit * np.sum(world == 0)].reshape(self.limit, -1)
            if np.any(world == 0)
            else np.zeros((self.limit, 0), dtype=int)
            for world, rows in groups.values()
        )
        self.body_slot = np.full(model.body_count + 1, -1)  # the last is read for parent -1
        self.body_slot[self.bodies] = np.arange(self.bodies.shape[1])
        self.hinge_slot = np.full(model.joint_count + 1, -1)
        self.hinge_slot[self.hinges] = np.arange(self.hinges.shape[1])

    def _world_of_bodies(self) -> np.ndarray:
        world = host(self.model, "body_world")
        outside = np.flatnonzero(world < 0)
        self.declared = len(outside) < len(world)
        if not self.declared:
            self.count = 1
            return np.zeros_like(world)
        if len(outside):
            raise UnsupportedError(
                "from_newton",
                f"body {self.model.body_label[outside[0]]!r}, global beside {self.model.world_count} worlds,",
                "put every body into a world (ModelBuilder.add_world, replicate), or none",
            )
        self.count = self.model.world_count
        return world

    def _carries(self) -> np.ndarray:
        """Whether each joint is the hinge of its child: articulated joints first, then the first that stands alone."""
        articulated = self.articulation >= 0
        order = np.lexsort((np.arange(len(self.child)), ~articulated))
        carried, first = np.unique(self.child[order], return_index=True)
        lost = np.setdiff1d(np.arange(self.model.body_count), carried)
        if len(lost):
            raise UnsupportedError(
                "from_newton",
                f"a body that is the child of no joint ({names_of([self.model.body_label[body] for body in lost])})",
                "add ModelBuilder.add_joint_free(child=body), or add_joint_fixed if it stands still",
            )
        self.carrier = np.zeros(self.model.body_count, dtype=int)
        self.carrier[carried] = order[first]
        hinge = articulated.copy()
        hinge[self.carrier] = True
        return hinge

    def _check_joints(self, is_hinge: np.ndarray, body_world: np.ndarray) -> None:
        def refuse(mask: np.ndarray, what: str, way_out: str) -> None:
            if mask.any():
                label = self.model.joint_label[np.flatnonzero(mask)[0]]
                raise UnsupportedError("from_newton", f"joint {label!r}, {what},", way_out)

        inner = self.parent >= 0
        refuse(
            inner & (body_world[self.parent] != body_world[self.child]),
            "which joins bodies of two worlds",
            "put both bodies into one world",
        )
        parent_articulation = np.where(inner, self.articulation[self.carrier[self.parent]], -1)
        strays = is_hinge & (self.articulation >= 0) & (parent_articulation >= 0)
        refuse(
            strays & (parent_articulation != self.articulation),
            "whose parent belongs to another articulation",
            "put all connected tree joints into one add_articulation",
        )
        refuse(
            is_hinge & ~self.enabled,
            "a disabled joint of the tree",
            "enable it, or build the model with a free joint in its place",
        )
        flags = host(self.model, "body_flags")[self.child] & int(newton.BodyFlags.KINEMATIC)
        refuse(
            is_hinge & (flags != 0) & (self.type != JointType.FIXED),
            "which carries a kinematic body",
            "build the body with is_kinematic=False and prescribe its hinge (Dynamics.hybrid_dynamics)",
        )

    def _mimics(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Follower joints, reference joints, and (offset, ratio) of every mimic, joint-owned ones first."""
        model = self.model
        if model.joint_count == 0:
            return np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros((0, 2))
        reference, coeffs = host(model, "joint_mimic_joint"), host(model, "joint_mimic_coeffs").reshape(-1, 2)
        follower = np.flatnonzero(reference >= 0)
        reference, coeffs = reference[follower], coeffs[follower]
        if model.constraint_mimic_count:  # the older, separate list
            on = host(model, "constraint_mimic_enabled").astype(bool)
            old = lambda name: host(model, f"constraint_mimic_{name}")[on]  # noqa: E731
            follower, reference = np.append(follower, old("joint0")), np.append(reference, old("joint1"))
            coeffs = np.concatenate([coeffs, np.stack([old("coef0"), old("coef1")], axis=1)])
        return follower.astype(int), reference.astype(int), coeffs.astype(np.float64)

    def check_equal(self) -> None:
        """Raise unless every world has world 0's topology: the joints, what they join, their axes, loops and mimics."""

        def compare(name: str, values: np.ndarray, rows: np.ndarray) -> None:
            differs = values[: self.limit] != values[:1]
            found = np.argwhere(differs.any(axis=tuple(range(2, differs.ndim))))
            if len(found):
                self.limit, slot = found[0]
                got, expected = values[self.limit, slot].tolist(), values[0, slot].tolist()
                label = self.model.joint_label[rows[0, slot]]
                self.what = f"the {name} of joint {label!r} is {got} where world 0 has {expected}"

        for rows in (self.hinges, self.loops):
            compare("type", self.type[rows], rows)
            compare("parent (body of its world)", self.body_slot[self.parent[rows]], rows)
            compare("child (body of its world)", self.body_slot[self.child[rows]], rows)
            compare("number of linear and angular axes", self.dof_dim.reshape(-1, 2)[rows], rows)
            for slot in range(rows.shape[1]):
                joint = rows[: self.limit, slot : slot + 1]
                count = self.dof_dim[joint[0, 0]].sum()
                axes = self.axis[self.qd_start[joint][..., None] + np.arange(count)]
                compare("axis", axes, joint)
        compare("anchor in the parent of loop", self.X_p.reshape(-1, 7)[self.loops], self.loops)
        compare("anchor in the child of loop", self.X_c.reshape(-1, 7)[self.loops], self.loops)
        follower, reference, coeffs = self.mimics
        rows = follower[self.mimic_rows]
        compare("position in its world of mimic", self.hinge_slot[rows], rows)
        compare("mimic reference", self.hinge_slot[reference[self.mimic_rows]], rows)
        compare("mimic offset and ratio", coeffs[self.mimic_rows], rows)
        if self.limit < self.count:
            raise UnsupportedError(
                "from_newton",
                f"world {self.limit}, which differs from world 0: {self.what},",
                "make one model for each kind of world",
            )

    def edge(self, joint: int) -> dict[str, Any]:
        """Arguments that :class:`Hinge` and :class:`Loop` share, of a joint of world 0."""
        kind = KINDS[JointType(self.type[joint])]
        linear, angular = self.dof_dim[joint]
        start = self.qd_start[joint]
        axes = _unit(self.axis[start : start + linear + angular].astype(np.float64))
        arguments: dict[str, Any] = {"kind": kind}
        if kind in ("revolute", "prismatic"):
            arguments["axis"] = axes[0]
        if kind == "d6":
            arguments |= {"linear": axes[:linear], "angular": self._orthogonal(axes[linear:], joint)}
        return arguments | {
            "parent": int(self.body_slot[self.parent[joint]]),
            "child": int(self.body_slot[self.child[joint]]),
            "parent_pose": _unit_pose(self.X_p[joint].astype(np.float64)),
            "child_pose": _unit_pose(self.X_c[joint].astype(np.float64)),
        }

    def _orthogonal(self, axes: np.ndarray, joint: int) -> np.ndarray:
        """``axes`` of rotation of a D6, refused if oblique: Newton 1.8's eval_fk turns two such axes into others (it
        reads a quaternion from a matrix that is no rotation), and eval_ik three, so q would not mean what it says."""
        cosine = np.abs(axes @ axes.T - np.eye(len(axes))).max(initial=0.0)
        if cosine > OBLIQUE:
            raise UnsupportedError(
                "from_newton",
                f"D6 joint {self.model.joint_label[joint]!r} with oblique angular axes {axes.round(6).tolist()}",
                "make them orthogonal, put a revolute joint on an intermediate body for each, or build the Scene by "
                "hand, where Hinge('d6', angular=...) takes any axes",
            )
        return axes

    def couplings(self) -> list[tuple[int, int, np.ndarray]]:
        """(hinge, reference hinge, (offset, ratio)) of world 0's mimics."""
        rows = self.mimic_rows[0]
        result = []
        for joint, reference, coeffs in zip(*(array[rows] for array in self.mimics), strict=True):
            slots = self.hinge_slot[[joint, reference]]
            if min(slots) < 0 or any(self.dof_dim[j].sum() != 1 for j in (joint, reference)):
                raise UnsupportedError(
                    "from_newton",
                    f"the mimic of joint {self.model.joint_label[joint]!r} on {self.model.joint_label[reference]!r}",
                    "expected two tree joints with one coordinate each",
                )
            result.append((*slots, coeffs))
        return result

    def labels(self, labels: list[str], rows: np.ndarray) -> list[str]:
        """World 0's labels, without a leading part that is each world's own."""
        first = [labels[row] for row in rows[0]]
        if self.count == 1 or not first:
            return first
        prefixes, rests = (list(part) for part in zip(*(label.partition("/")[::2] for label in first), strict=True))
        others = [labels[row].partition("/") for row in rows[1]]
        own = all(
            other[0] != prefix and other[2] == rest != ""
            for other, prefix, rest in zip(others, prefixes, rests, strict=True)
        )
        return rests if own else first


def host(owner: Any, name: str) -> np.ndarray:
    return getattr(owner, name).numpy()


def names_of(labels: list[str]) -> str:
    return ", ".join(repr(label) for label in labels[:8]) + (f" and {len(labels) - 8} more" if len(labels) > 8 else "")


def _entries(start: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Flat entries [world, n] that ``joints`` [world, joint] own, ``start`` being the prefix sum over all joints."""
    parts = [start[joints[:, h]][:, None] + np.arange(start[j + 1] - start[j]) for h, j in enumerate(joints[0])]
    return np.concatenate([np.zeros((len(joints), 0), dtype=np.int64), *parts], axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """``vectors`` at unit length where float32 rounded it; others unchanged, for :class:`Scene` to refuse."""
    norm = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(np.abs(norm - 1.0) < ROUNDING, norm, 1.0)


def _unit_pose(pose: np.ndarray) -> np.ndarray:
    return np.concatenate([pose[..., :3], _unit(pose[..., 3:])], axis=-1)


def _unit_or_identity(quaternions: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return np.where(norm > 0.0, quaternions / np.where(norm > 0.0, norm, 1.0), [0.0, 0.0, 0.0, 1.0])


def _symmetric(inertia: np.ndarray) -> np.ndarray:
    skew = np.abs(inertia - np.swapaxes(inertia, -1, -2)).max(axis=(-1, -2), keepdims=True)
    rounded = skew <= ASYMMETRY * np.abs(inertia).max(axis=(-1, -2), keepdims=True)
    return np.where(rounded, 0.5 * (inertia + np.swapaxes(inertia, -1, -2)), inertia)


def _drop_distance_limits(label: str, values: dict[str, np.ndarray], dofs: slice) -> None:
    """Newton keeps a DISTANCE joint's interval where the limits of its first coordinate would be."""
    low, high = values["joint_limit_lower"][:, dofs.start], values["joint_limit_upper"][:, dofs.start]
    if (low > 0.0).any() or ((high >= 0.0) & (high < UNLIMITED)).any():
        warnings.warn(
            f"from_newton: DISTANCE joint {label!r} becomes a free hinge; its distance limit "
            f"[{low[0]:g}, {high[0]:g}] m is left out",
            UserWarning,
            stacklevel=3,
        )
    values["joint_limit_lower"][:, dofs], values["joint_limit_upper"][:, dofs] = -UNLIMITED, UNLIMITED
