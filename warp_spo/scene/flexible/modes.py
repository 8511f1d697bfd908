"""Modes: the elastic deformation of a body as a sum of shapes, each with an amplitude that is a coordinate.

The shapes are relative to the body frame, which stays where the body's hinge puts it. Rotations come before
displacements, angular momentum before linear momentum, as in the paper's spatial vectors; all are in the axes of the
body frame.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ...errors import UnsupportedError
from ...hinges.hinge_type import ElementaryHinge, HingeType
from ..checks import SYMMETRY, checked_array, read_only
from ..pickling import StoredPart

MASS_VALUES = ("body_mass", "body_com", "body_inertia")
MOST_MODES = 20
INDEFINITE = 1e-6  # least eigenvalue of a scaled mass matrix that rounding of the numbers of a file may leave
ROUNDING = 1e-12  # share of the diagonal below which an entry of a mass matrix is rounding


class Amplitudes(HingeType):
    """The modal coordinates of a body: scalars whose rates are qd; see ``hinges.deflection`` for what they move."""

    name = "modes"

    def __init__(self, count: int):
        self.dofs = self.coordinates = count

    @property
    def depth(self) -> int:
        return 1


@dataclasses.dataclass(frozen=True, eq=False)
class MassPoints(StoredPart):
    """Places and displacements of the mass of a flexible body.

    Args:
        mass: of each point [kg], shape (s,), not negative.
        position: of each point at rest, in the body frame [m], shape (s, 3).
        shapes: displacement per unit of each amplitude [m], shape (s, 3, n).
        stiffening: second-order displacement, shape (s, 3, n, n): of amplitudes eta, - eta* G eta / 2 [m]; None: zero.

    Raises:
        ValueError: a shape is wrong, or a mass is negative.
    """

    mass: Any
    position: Any
    shapes: Any
    stiffening: Any = None

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        masses, sizes = _shape(self.mass), _shape(self.shapes)
        count = masses[0] if len(masses) == 1 else 0
        n = sizes[-1] if len(sizes) == 3 else 0
        if count == 0 or n == 0:
            raise ValueError(
                f"MassPoints: mass has shape {masses} and shapes {sizes}; expected (s,) and (s, 3, n), for s points "
                "and n modes"
            )
        put("mass", checked_array("MassPoints", "mass [kg]", self.mass, (count,)))
        if self.mass.min() < 0.0:
            raise ValueError(f"MassPoints: mass holds {self.mass.min()} kg; expected zero or more")
        put("position", checked_array("MassPoints", "position [m]", self.position, (count, 3)))
        put("shapes", checked_array("MassPoints", "shapes", self.shapes, (count, 3, n)))
        if self.stiffening is not None:
            put("stiffening", _symmetric("MassPoints", "stiffening", self.stiffening, (count, 3, n, n)))

    @property
    def momenta(self) -> np.ndarray:
        """Momentum of each point per unit rate of the body frame (omega; v) and of the amplitudes [s, 3, 6 + n]."""
        x, y, z = self.position.T
        o = np.zeros_like(x)
        turning = np.moveaxis(np.array([[o, z, -y], [-z, o, x], [y, -x, o]]), 2, 0)  # omega x r
        moving = np.broadcast_to(np.eye(3), (len(self.mass), 3, 3))
        return np.concatenate([turning, moving, self.shapes], axis=2)

    @property
    def inertia(self) -> np.ndarray:
        """Mass matrix of the points for (omega; v) of the body frame and the amplitudes, at rest [6 + n, 6 + n]."""
        J = self.momenta
        return np.einsum("s,sai,saj->ij", self.mass, J, J)


@dataclasses.dataclass(frozen=True, eq=False)
class Modes(StoredPart):
    """The modes of a flexible body.

    The kinetic energy of the body at rest in its shape is that of the arrays, (V; eta')* [I, L*; L, M] (V; eta') / 2.
    In another shape it is that of rigid pieces that move with the amplitudes: the mass ``points`` where they are given,
    otherwise one rigid piece that moves as the body does on average. Momentum and energy are conserved in either case.
    With points, the inertia of a deformed body is exact to second order in the amplitudes.

    Modal stiffness and damping become ``joint_stiffness`` and ``joint_damping`` of the modal coordinates: they belong
    to :meth:`Dynamics.passive_force` and, implicit, to :meth:`Dynamics.step`.

    How the rest moves on average with the modes follows from the body's mass, centre of mass and inertia in the scene.
    If these are ``variable``, :meth:`Dynamics.set` changes the inertia of a flexible body and keeps that motion.

    Args:
        mass: modal mass M, shape (n, n); None: that of the points.
        stiffness: of each amplitude, shape (n,), or a diagonal matrix (n, n).
        damping: of each amplitude, shape (n,), or a diagonal matrix (n, n); None: zero.
        coupling: momentum of the body per unit rate of each amplitude, shape (6, n): angular about the origin of the
            body frame, then linear; None: that of the points.
        slopes: by label or index of a child body, or by name of a site: rotation [rad] and displacement [m], per unit
            of each amplitude, of the child's parent anchor or of the site, shape (6, n).
        stiffening: by the same names: second-order displacement of the anchor along each axis, shape (3, n, n): of
            amplitudes eta, - eta* G eta / 2 [m]. Those of a beam are its foreshortening; with them a beam that is spun
            or pulled becomes stiffer, and one that is pushed buckles.
        points: distribution of the body's mass.
        rigid: (mass [kg], com (3,) [m], inertia about the com (3, 3) [kg m^2]) of the whole body, so that
            ``Body(*modes.rigid, modes=modes)`` is the body; None where it comes from elsewhere.
        shape: ``shape(position)`` returns slopes (6, n) and stiffening (3, n, n), or None, of any point [m] of the
            body: for children, sites and frames that ``slopes`` does not name. A function of a module, or an object.

    Raises:
        ValueError: a shape is wrong, a matrix is not symmetric or not diagonal, or a mass is missing.
        TypeError: ``points`` are no MassPoints, or ``shape`` cannot be called.
    """

    mass: Any = None
    stiffness: Any = None
    damping: Any = None
    coupling: Any = None
    slopes: Any = None
    stiffening: Any = None
    points: MassPoints | None = None
    rigid: Any = None
    shape: Any = None

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        if self.points is not None and not isinstance(self.points, MassPoints):
            raise TypeError(f"Modes: points is {self.points!r}; expected spo.MassPoints")
        if self.shape is not None and not callable(self.shape):
            raise TypeError(f"Modes: shape is {self.shape!r}; expected a function of a position")
        if self.points is None and (self.mass is None or self.coupling is None):
            raise ValueError(
                "Modes: mass and coupling are missing; expected (n, n) and (6, n), or points=MassPoints(...)"
            )
        sizes = _shape(self.mass) if self.points is None else self.points.shapes.shape
        if len(sizes) < 2:
            raise ValueError(f"Modes: mass is {self.mass!r}; expected numbers of shape (n, n), for n modes")
        n = sizes[-1]
        if not 1 <= n <= MOST_MODES:
            raise ValueError(f"Modes: {n} modes; expected 1 to {MOST_MODES}")
        own = np.zeros((6 + n, 6 + n)) if self.points is None else self.points.inertia
        mass = own[6:, 6:] if self.mass is None else self.mass
        put("mass", _symmetric("Modes", "mass", mass, (n, n)))
        coupling = own[:6, 6:] if self.coupling is None else self.coupling
        put("coupling", checked_array("Modes", "coupling", coupling, (6, n)))
        if self.stiffness is None:
            raise ValueError("Modes: stiffness is missing; expected one number for each mode, shape (n,)")
        put("stiffness", _diagonal("stiffness", self.stiffness, n))
        put("damping", _diagonal("damping", np.zeros(n) if self.damping is None else self.damping, n))
        put("slopes", _by_name("slopes", {} if self.slopes is None else self.slopes, (6, n)))
        put("stiffening", _by_name("stiffening", {} if self.stiffening is None else self.stiffening, (3, n, n)))
        alone = [name for name in self.stiffening if name not in self.slopes]
        if alone:
            raise ValueError(
                f"Modes: stiffening names {alone[0]!r}, which slopes does not; expected the same names; add its slopes"
            )

    @property
    def count(self) -> int:
        """The number of modes."""
        return len(self.stiffness)

    def slopes_at(self, name: Any, position: Any, what: str) -> tuple[np.ndarray, np.ndarray | None]:
        """Return slopes (6, n) and stiffening (3, n, n), or None, of a child or site ``name`` at ``position`` [m].

        Raises:
            ValueError: neither the slopes by name nor the shape tell; ``what`` names the point.
        """
        if name in self.slopes:
            return self.slopes[name], self.stiffening.get(name)
        if self.shape is None:
            raise ValueError(
                f"Scene: {what} is on a body with modes that has no slopes for it; expected "
                f"Modes(slopes={{{name!r}: an array (6, {self.count})}}), zeros if it sits where the body does not "
                "deform, or Modes(shape=...)"
            )
        found = self.shape(np.array(position, dtype=np.float64))
        if not isinstance(found, tuple | list) or len(found) != 2:
            raise ValueError(
                f"Modes: shape returns {found!r} for {what}; expected slopes (6, {self.count}), and stiffening "
                f"(3, {self.count}, {self.count}) or None"
            )
        slopes, bends = found
        slopes = checked_array("Modes", f"what shape returns for {what}, slopes", slopes, (6, self.count))
        name, size = f"what shape returns for {what}, stiffening", (3, self.count, self.count)
        return slopes, None if bends is None else _symmetric("Modes", name, bends, size)


def slopes_of_child(scene: Any, child: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Return slopes and stiffening of the point of a body with modes that carries a child, by its label or index."""
    hinge = scene.hinges[scene.hinge_of[child]]
    modes, label = scene.bodies[hinge.parent].modes, scene.body_labels[child]
    name = int(child) if int(child) in modes.slopes else label
    return modes.slopes_at(name, hinge.parent_pose[:3], f"body {label!r}")


def slopes_of_frame(scene: Any, body: int, position: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray | None]:
    """Return slopes and stiffening of a point of a body with modes: those of a site there, or by its shape."""
    modes = scene.bodies[body].modes
    sites = [name for name, (on, pose) in scene.sites.items() if on == body and tuple(pose[:3]) == position]
    name = next((site for site in sites if site in modes.slopes), (sites or ["name of a site"])[0])
    return modes.slopes_at(name, position, f"the frame at {position} of body {scene.body_labels[body]!r}")


def check_modes(scene: Any, call: str = "Scene") -> None:
    """Check that the modes of a scene's bodies suit the bodies, their children and sites.

    Raises:
        ValueError: they do not.
        UnsupportedError: mass, centre of mass or inertia of a body with modes differ between worlds.
    """
    for body, part in enumerate(scene.bodies):
        if part.modes is None:
            continue
        label, children = scene.body_labels[body], scene.tree.children[body]
        for name in MASS_VALUES:
            if (scene.values[name][:, body] != scene.values[name][0, body]).any():
                what = f"{name} of body {label!r}, which has modes, that differs between worlds"
                raise UnsupportedError(call, what, "use one scene and one Dynamics for each")
        mean_motion(label, part.modes, *(scene.values[name][0, body] for name in MASS_VALUES))
        for child in children:
            slopes_of_child(scene, child)
        _refuse_ambiguous_names(scene, body)
        known = [*map(int, children), *(scene.body_labels[child] for child in children)]
        known += [name for name, (on, _) in scene.sites.items() if on == body]
        for name in (*part.modes.slopes, *part.modes.stiffening):
            if name not in known:
                names = ", ".join(map(repr, known)) or "its children and sites, of which there are none"
                raise ValueError(
                    f"Scene: the modes of body {label!r} have slopes for {name!r}, which is no child and no site of "
                    f"it; expected one of {names}"
                )


def _refuse_ambiguous_names(scene: Any, body: int) -> None:
    """Raise ValueError if one of the slopes by name of a body is of two places, or if one place has two of them."""
    slopes, children = scene.bodies[body].modes.slopes, scene.tree.children[body]
    call = f"Scene: the modes of body {scene.body_labels[body]!r} have slopes"
    sites = {name: pose[:3] for name, (on, pose) in scene.sites.items() if on == body and name in slopes}
    labels = [scene.body_labels[child] for child in children]
    for child, label in zip(children, labels, strict=True):
        if int(child) in slopes and label in slopes:
            raise ValueError(f"{call} for {label!r} and for its index {int(child)}; expected one of them")
        if label in slopes and (label in sites or labels.count(label) > 1):
            raise ValueError(f"{call} for {label!r}, a name of several places; expected a name for each; rename one")
    for name, place in sites.items():
        if not any(place) and slopes[name].any():
            raise ValueError(
                f"{call} for site {name!r} at its origin, where frames are the body frame; expected zeros, or a "
                "site elsewhere; a body on a fixed hinge may sit there, and deforms with its slopes"
            )
        for other in sites:
            if sites[other] == place and (slopes[other] != slopes[name]).any():
                raise ValueError(
                    f"{call} for sites {name!r} and {other!r}, which sit at the same place; expected equal ones"
                )


class MeanMotion(NamedTuple):
    """Average motion of a body in its modes.

    Attributes:
        center: centre of mass [m]. slopes: rotation and displacement there, (6, n).
        rest_center, rest_slopes: the same of what its mass points leave of the body.
        armature: the modal mass that moves neither the points nor the rest, (n, n).
    """

    center: np.ndarray
    slopes: np.ndarray
    rest_center: np.ndarray
    rest_slopes: np.ndarray
    armature: np.ndarray


def mean_motion(label: str, modes: Modes, mass: float, com: np.ndarray, inertia: np.ndarray) -> MeanMotion:
    """Return the mean motion of a body with modes: the slopes that give its momentum, M_rr slopes = coupling.

    Raises:
        ValueError: the points have more mass than the body, or the mass matrix of body and modes has a negative
            eigenvalue.
    """
    whole = np.zeros((6 + modes.count, 6 + modes.count))
    whole[:6, :6] = _spatial(mass, com, inertia)
    whole[:6, 6:], whole[6:, :6], whole[6:, 6:] = modes.coupling, modes.coupling.T, modes.mass
    own = np.zeros_like(whole) if modes.points is None else modes.points.inertia
    scale = np.sqrt(np.maximum(np.diag(whole), np.diag(own)))
    scale[:3], scale[3:6] = scale[:3].max(), scale[3:6].max()
    scale[scale == 0.0] = 1.0
    for what, matrix in (("body and modes", whole), ("what the points leave of body and modes", whole - own)):
        least = np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0]
        if least < -INDEFINITE:
            raise ValueError(
                f"Scene: body {label!r}: the mass matrix of {what} has the eigenvalue {least:.3g}, in units of its "
                "diagonal; expected none below zero; correct mass, com and inertia of the Body (about its com), mass "
                "and coupling of its Modes (about the origin of the body frame), or their points"
            )
    rest = np.where(np.abs(whole - own) > ROUNDING * np.outer(scale, scale), whole - own, 0.0)
    center, slopes = _slopes(whole, scale)
    rest_center, rest_slopes = (center, slopes) if modes.points is None else _slopes(rest, scale)
    about_origin = rest_slopes.copy()
    about_origin[3:] += np.cross(rest_center, rest_slopes[:3].T).T
    armature = rest[6:, 6:] - rest[6:, :6] @ about_origin
    armature = np.where(np.abs(armature) > ROUNDING * np.outer(scale[6:], scale[6:]), armature, 0.0)
    return MeanMotion(center, slopes, rest_center, rest_slopes, 0.5 * (armature + armature.T))


def _slopes(matrix: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the centre of mass of the rigid part of a mass matrix, and the mean motion there per unit of each mode."""
    rigid = matrix[:6, :6] / np.outer(scale[:6], scale[:6])
    found = np.linalg.pinv(rigid, rcond=1e-9, hermitian=True) @ (matrix[:6, 6:] / scale[:6, None]) / scale[:6, None]
    found[np.abs(found) < ROUNDING * np.abs(found).max(axis=1, keepdims=True)] = 0.0
    center = np.zeros(3)
    if matrix[3, 3] > 0.0:
        center = np.array([matrix[2, 4], matrix[0, 5], matrix[1, 3]]) / matrix[3, 3]
    found[3:] += np.cross(found[:3].T, center).T
    return center, found


def _spatial(mass: float, com: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Return the 6 x 6 inertia about the body frame's origin of a body with this inertia about its com."""
    x, y, z = com
    arm = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[inertia - mass * arm @ arm, mass * arm], [-mass * arm, mass * np.eye(3)]])


def _shape(value: Any) -> tuple[int, ...]:
    """Return the shape of an array; () of what is none."""
    try:
        return np.shape(value)
    except ValueError:  # rows of several lengths
        return ()


def _symmetric(call: str, name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array whose last two axes are symmetric, made exactly so."""
    array = checked_array(call, name, value, shape)
    skew = np.abs(array - np.swapaxes(array, -1, -2)).max()
    if skew > SYMMETRY * np.abs(array).max():
        raise ValueError(f"{call}: {name} is not symmetric, by {skew:.3g}; expected its last two axes to be")
    return read_only(0.5 * (array + np.swapaxes(array, -1, -2)))


def _diagonal(name: str, value: Any, n: int) -> np.ndarray:
    """Return the entries of a diagonal matrix that is given as such or as a vector."""
    array = checked_array("Modes", name, value, (n, n) if len(_shape(value)) == 2 else (n,))
    if array.ndim == 1:
        return array
    off = np.abs(array - np.diag(np.diag(array))).max()
    if off > SYMMETRY * np.abs(array).max():
        raise ValueError(
            f"Modes: {name} has the off-diagonal entry {off:.3g}; expected a diagonal matrix; spo.normal_modes "
            "takes a full one and returns the modes in amplitudes in which it is diagonal"
        )
    return read_only(np.diag(array).copy())


def _by_name(name: str, value: Any, shape: tuple[int, ...]) -> Mapping[Any, np.ndarray]:
    """Return checked arrays by name."""
    if not isinstance(value, Mapping):
        raise ValueError(f"Modes: {name} is {value!r}; expected arrays {shape} by label of a child")
    check = _symmetric if len(shape) == 3 else checked_array
    return MappingProxyType({key: check("Modes", f"{name}[{key!r}]", array, shape) for key, array in value.items()})


def with_modes(hinge: Any, modes: Modes | None, defaults: Mapping[str, float]) -> Any:
    """Return a hinge that owns the modal coordinates of its child after its own; the hinge itself without modes.

    ``defaults``: values of a degree of freedom of which nothing is said, by name of the hinge's attribute.
    """
    plain = vars(hinge).get("without_modes", hinge)
    if modes is None:
        return plain
    found = object.__new__(type(plain))
    added = {name: np.full(modes.count, value) for name, value in defaults.items()}
    added |= {"stiffness": modes.stiffness, "damping": modes.damping, "rest": np.zeros(modes.count)}
    vars(found).update(vars(plain))
    vars(found).update({name: read_only(np.concatenate([getattr(plain, name), x])) for name, x in added.items()})
    vars(found).update(elements=(*plain.elements, ElementaryHinge(Amplitudes(modes.count))), without_modes=plain)
    return found
