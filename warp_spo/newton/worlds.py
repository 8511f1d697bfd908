"""Rows of a Newton model's flat arrays that belong to each world, and whether all worlds have the same topology."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
from newton import JointType

from ..errors import UnsupportedError, quoted

KINDS = {
    JointType.FIXED: "fixed",
    JointType.PRISMATIC: "prismatic",
    JointType.REVOLUTE: "revolute",
    JointType.BALL: "ball",
    JointType.FREE: "free",
    JointType.DISTANCE: "distance",
    JointType.D6: "d6",
}
ROUNDING = 1e-3  # a quaternion or axis whose length differs from 1 by less is a rounded unit vector
OBLIQUE = 1e-3  # cosine of the angle between two D6 axes below which they are orthogonal up to a file's digits


class WorldRows:
    """Rows of a model's flat arrays for each world.

    Attributes:
        bodies, hinges, loops: rows of the model's bodies, tree joints and enabled loop joints, each [world, n].
        count: number of worlds.
        declared: whether the model has worlds; a model without worlds counts as one world.
    """

    def __init__(self, model: newton.Model):
        if model.body_count == 0:
            raise ValueError("from_newton: the model has no bodies; expected one or more")
        self.model = model
        read = lambda name: to_numpy(model, f"joint_{name}") if model.joint_count else np.zeros(0, dtype=int)  # noqa: E731
        self.type, self.parent, self.child = read("type"), read("parent"), read("child")
        self.articulation, self.enabled = read("articulation"), read("enabled").astype(bool)
        self.dof_dim, self.X_p, self.X_c = read("dof_dim"), read("X_p"), read("X_c")
        self.q_start, self.qd_start = read("q_start"), read("qd_start")
        self.axis = to_numpy(model, "joint_axis") if model.joint_dof_count else np.zeros((0, 3))
        body_world = self._world_of_bodies()
        joint_world = body_world[self.child]
        is_hinge = self._find_hinges()
        self._check_joints(is_hinge, body_world)
        is_loop = ~is_hinge & self.enabled

        # Worlds below ``limit`` are equal as far as they have been compared; ``difference`` says how the world at
        # ``limit`` differs. Counts are compared first, because rows of worlds with other counts cannot be compared.
        self.limit, self.difference = self.count, ""
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
                self.difference = f"it has {counts[self.limit]} {name} where world 0 has {counts[0]}"
        self.bodies, self.hinges, self.loops, self.mimic_rows = (
            rows[np.argsort(world, kind="stable")][: self.limit * np.sum(world == 0)].reshape(self.limit, -1)
            if np.any(world == 0)
            else np.zeros((self.limit, 0), dtype=int)
            for world, rows in groups.values()
        )
        self.body_slot = np.full(model.body_count + 1, -1)  # the last entry is read for parent -1
        self.body_slot[self.bodies] = np.arange(self.bodies.shape[1])
        self.hinge_slot = np.full(model.joint_count + 1, -1)
        self.hinge_slot[self.hinges] = np.arange(self.hinges.shape[1])

    def _world_of_bodies(self) -> np.ndarray:
        """Return the world of each body [body]."""
        world = to_numpy(self.model, "body_world")
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

    def _find_hinges(self) -> np.ndarray:
        """Return for each joint whether it is the hinge of its child [joint], bool.

        Every joint of an articulation is one. A child without such a joint takes the first joint that has it as child.
        """
        articulated = self.articulation >= 0
        order = np.lexsort((np.arange(len(self.child)), ~articulated))
        carried, first = np.unique(self.child[order], return_index=True)
        lost = np.flatnonzero(np.bincount(carried, minlength=self.model.body_count) == 0)
        if len(lost):
            labels = self.model.body_label
            raise UnsupportedError(
                "from_newton",
                f"a body that is the child of no joint ({quote_labels([labels[body] for body in lost])})",
                "add ModelBuilder.add_joint_free(child=body), or add_joint_fixed if it stands still",
            )
        self.hinge_of = np.zeros(self.model.body_count, dtype=int)
        self.hinge_of[carried] = order[first]
        hinge = articulated.copy()
        hinge[self.hinge_of] = True
        return hinge

    def _check_joints(self, is_hinge: np.ndarray, body_world: np.ndarray) -> None:
        """Raise UnsupportedError that names the first joint which no scene can represent."""

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
        parent_articulation = np.where(inner, self.articulation[self.hinge_of[self.parent]], -1)
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
        flags = to_numpy(self.model, "body_flags")[self.child] & int(newton.BodyFlags.KINEMATIC)
        refuse(
            is_hinge & (flags != 0) & (self.type != JointType.FIXED),
            "which carries a kinematic body",
            "build the body with is_kinematic=False and prescribe its hinge (Dynamics.hybrid_dynamics)",
        )

    def _mimics(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the follower joint, the reference joint and (offset, ratio) of every mimic.

        Mimics that joints own come first, then those of the older constraint_mimic arrays.
        """
        model = self.model
        if model.joint_count == 0:
            return np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros((0, 2))
        reference, coeffs = to_numpy(model, "joint_mimic_joint"), to_numpy(model, "joint_mimic_coeffs").reshape(-1, 2)
        follower = np.flatnonzero(reference >= 0)
        reference, coeffs = reference[follower], coeffs[follower]
        if model.constraint_mimic_count:
            on = to_numpy(model, "constraint_mimic_enabled").astype(bool)
            old = lambda name: to_numpy(model, f"constraint_mimic_{name}")[on]  # noqa: E731
            follower, reference = np.append(follower, old("joint0")), np.append(reference, old("joint1"))
            coeffs = np.concatenate([coeffs, np.stack([old("coef0"), old("coef1")], axis=1)])
        return follower.astype(int), reference.astype(int), coeffs.astype(np.float64)

    def check_equal(self) -> None:
        """Raise UnsupportedError unless every world has the joints, axes, loops and mimics of world 0."""

        def compare(name: str, values: np.ndarray, rows: np.ndarray) -> None:
            differs = values[: self.limit] != values[:1]
            found = np.argwhere(differs.any(axis=tuple(range(2, differs.ndim))))
            if len(found):
                self.limit, slot = found[0]
                got, expected = values[self.limit, slot].tolist(), values[0, slot].tolist()
                label = self.model.joint_label[rows[0, slot]]
                self.difference = f"the {name} of joint {label!r} is {got} where world 0 has {expected}"

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
                f"world {self.limit}, which differs from world 0: {self.difference},",
                "build one model for each kind of world",
            )

    def edge(self, joint: int) -> dict[str, Any]:
        """Return the arguments that :class:`Hinge` and :class:`Loop` share, for a joint of world 0."""
        kind = KINDS[JointType(self.type[joint])]
        linear, angular = self.dof_dim[joint]
        start = self.qd_start[joint]
        axes = unit_vectors(self.axis[start : start + linear + angular].astype(np.float64))
        arguments: dict[str, Any] = {"kind": kind}
        if kind in ("revolute", "prismatic"):
            arguments["axis"] = axes[0]
        if kind == "d6":
            arguments |= {"linear": axes[:linear], "angular": self._orthogonal(axes[linear:], joint)}
        return arguments | {
            "parent": int(self.body_slot[self.parent[joint]]),
            "child": int(self.body_slot[self.child[joint]]),
            "parent_pose": unit_pose(self.X_p[joint].astype(np.float64)),
            "child_pose": unit_pose(self.X_c[joint].astype(np.float64)),
        }

    def _orthogonal(self, axes: np.ndarray, joint: int) -> np.ndarray:
        """Return the angular ``axes`` of a D6 joint, or raise UnsupportedError if they are oblique.

        Newton 1.8 computes with other axes than oblique ones: eval_fk with two such axes, because it reads a quaternion
        from a matrix that is no rotation, and eval_ik with three. The coordinates would then mean something else.
        """
        cosine = np.abs(axes @ axes.T - np.eye(len(axes))).max(initial=0.0)
        if cosine > OBLIQUE:
            raise UnsupportedError(
                "from_newton",
                f"D6 joint {self.model.joint_label[joint]!r} with oblique angular axes {axes.round(6).tolist()}",
                "make them orthogonal, put a revolute joint on an intermediate body for each, or build the Scene by "
                "hand, where Hinge('d6', angular=...) accepts any axes",
            )
        return axes

    def couplings(self) -> list[tuple[int, int, np.ndarray]]:
        """Return (hinge, reference hinge, (offset, ratio)) of every mimic of world 0."""
        rows = self.mimic_rows[0]
        result = []
        for joint, reference, coeffs in zip(*(array[rows] for array in self.mimics), strict=True):
            slots = self.hinge_slot[[joint, reference]]
            if min(slots) < 0 or any(self.dof_dim[j].sum() != 1 for j in (joint, reference)):
                raise UnsupportedError(
                    "from_newton",
                    f"the mimic of joint {self.model.joint_label[joint]!r} on {self.model.joint_label[reference]!r}",
                    "expected two tree joints with one coordinate each; remove the mimic, or replace its joints",
                )
            result.append((*slots, coeffs))
        return result

    def labels(self, labels: list[str], rows: np.ndarray) -> list[str]:
        """Return the labels of world 0, without a leading part, such as \"world_0/\", that differs between worlds."""
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


def to_numpy(owner: Any, name: str) -> np.ndarray:
    """Return a copy on the host of the Warp array that ``owner`` has under ``name``."""
    return getattr(owner, name).numpy()


def quote_labels(labels: list[str]) -> str:
    """Return the labels in quotes, the first eight of them and the number of the others."""
    return ", ".join(map(quoted, labels[:8])) + (f" and {len(labels) - 8} more" if len(labels) > 8 else "")


def flat_entries(start: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return the entries [world, n] of ``joints`` [world, joint] in a flat array; ``start`` [joint + 1] is where each
    joint's entries begin."""
    parts = [start[joints[:, h]][:, None] + np.arange(start[j + 1] - start[j]) for h, j in enumerate(joints[0])]
    return np.concatenate([np.zeros((len(joints), 0), dtype=np.int64), *parts], axis=1)


def unit_vectors(vectors: np.ndarray) -> np.ndarray:
    """Return ``vectors``, normalised where rounding explains their length; :class:`Scene` refuses the others."""
    norm = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(np.abs(norm - 1.0) < ROUNDING, norm, 1.0)


def unit_pose(pose: np.ndarray) -> np.ndarray:
    """Return poses [..., 7] with their quaternions normalised as by :func:`unit_vectors`."""
    return np.concatenate([pose[..., :3], unit_vectors(pose[..., 3:])], axis=-1)
