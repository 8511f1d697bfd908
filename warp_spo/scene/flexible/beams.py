"""Modal data of straight uniform beams.

A beam lies along the x axis of its body, from the body frame's origin to x = L. With the section's displacement v, w
along y, z, its twist theta and its stretch u, the energies per length are (Euler, Bernoulli and Rayleigh)

    2 T = rho A (u'^2 + v'^2 + w'^2) + rho ((Iy + Iz) theta'^2 + Iz v_x'^2 + Iy w_x'^2)      ' being rates
    2 U = E A u_x^2 + E Iz v_xx^2 + E Iy w_xx^2 + G J theta_x^2                        _x being derivatives

and the modes are functions of x for one of v, w, theta, u each. A bent beam does not grow longer: a point at x moves by
-1/2 int_0^x (v_s^2 + w_s^2) ds along the beam, the foreshortening, which gives a spun beam its stiffness.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...errors import as_integer
from ..checks import checked_array, read_only
from ..pickling import StoredPart
from .modes import MassPoints, Modes
from .sections import Material, Section, positive

DIRECTIONS = ("y", "z", "torsion", "axial")
"""Kinds of modes, in the order of the modal coordinates."""
MOVES = {
    "y": ((4, 1.0, 0), (2, 1.0, 1)),
    "z": ((5, 1.0, 0), (1, -1.0, 1)),
    "torsion": ((0, 1.0, 0),),
    "axial": ((3, 1.0, 0),),
}
"""For each direction the entries of (rotation, displacement) that its curves give: entry, sign, derivative."""
MOST_OF_AN_ELEMENT = {"y": 2, "z": 2, "torsion": 1, "axial": 1}
ENDS = ("clamped", "free", "element")
QUADRATURE = 1e-10  # relative error of integrals over the mass points; float64 sums of 100 terms leave 1e-14
FINE = 32  # Gauss points beyond three for each mode: integrals to rounding for up to 40 modes


@dataclasses.dataclass(frozen=True, eq=False)
class Curves(StoredPart):
    """Functions of the distance x along a beam of this length, and their derivatives.

    Function k is sum_j powers[k, j] x^j, plus waves[k] @ (exp(-b x), exp(b (x - L)), cos(b x), sin(b x)), b = rates[k].
    In this form nothing cancels, however high the mode.
    """

    length: float
    powers: np.ndarray  # [function, 4]
    waves: np.ndarray  # [function, 4]
    rates: np.ndarray  # [function], 1/m

    def values(self, x: Any, derivative: int = 0) -> np.ndarray:
        """Return the values, or those of a derivative, at the distances ``x`` [point]: [point, function]."""
        x, b, out = np.asarray(x, np.float64)[:, None], self.rates, 0.0
        for power in range(derivative, 4):
            out = out + self.powers[:, power] * math.perm(power, derivative) * x ** (power - derivative)
        turned = b * x + 0.5 * np.pi * derivative  # a derivative of a cosine is one a quarter of a turn ahead
        falling, rising = (-b) ** derivative * np.exp(-b * x), b**derivative * np.exp(b * (x - self.length))
        waves = (falling, rising, b**derivative * np.cos(turned), b**derivative * np.sin(turned))
        return out + sum(self.waves[:, i] * wave for i, wave in enumerate(waves))


def _eigenvalues(count: int, ends: str) -> np.ndarray:
    """Return the first ``count`` positive roots of cos z cosh z = -1 (clamped) or 1 (free)."""
    sign, first = (1.0, 0.5) if ends == "clamped" else (-1.0, 1.5)
    z = np.pi * (np.arange(count) + first)
    for _ in range(20):
        z = z + (np.cos(z) + sign / np.cosh(z)) / (np.sin(z) + sign * np.tanh(z) / np.cosh(z))
    return z


def _bending(length: float, count: int, ends: str) -> Curves:
    """Return bending shapes; each eigenfunction, each shape of an element is 1 at x = L."""
    if ends == "element":
        powers = [(0, 0, 1 / length**2, 0), (0, 0, 3 / length**2, -2 / length**3)][:count]
        return Curves(length, np.reshape(powers, (count, 4)), np.zeros((count, 4)), np.zeros(count))
    z = _eigenvalues(count, ends)
    s, c, e = np.sin(z), np.cos(z), np.exp(-z)
    if ends == "clamped":  # cosh - cos - a (sinh - sin)
        rising = (s - c - e) / (1.0 - e**2 + 2.0 * e * s)  # (1 - a) / 2 exp(z)
        a = 1.0 - 2.0 * rising * e
        waves = np.stack([1.0 - rising * e, rising, -np.ones(count), a], axis=1)
    else:  # cosh + cos - a (sinh + sin)
        rising = (c - s - e) / (1.0 - e**2 - 2.0 * e * s)
        a = 1.0 - 2.0 * rising * e
        waves = np.stack([1.0 - rising * e, rising, np.ones(count), -a], axis=1)
    end = waves[:, 0] * e + waves[:, 1] + waves[:, 2] * c + waves[:, 3] * s
    return _relative(Curves(length, np.zeros((count, 4)), waves / end[:, None], z / length), 2 * (ends == "free"))


def _rod(length: float, count: int, ends: str) -> Curves:
    """Return shapes of torsion or stretch; each eigenfunction, each shape of an element is 1 at x = L."""
    none = np.zeros((count, 4))
    if ends == "element":
        return Curves(length, np.tile((0.0, 1.0 / length, 0.0, 0.0), (count, 1)), none, np.zeros(count))
    k = np.arange(count) + (0.5 if ends == "clamped" else 1.0)
    waves = none.copy()
    waves[:, 3 if ends == "clamped" else 2] = (-1.0) ** (np.arange(count) + (ends == "free"))
    return _relative(Curves(length, none, waves, np.pi * k / length), ends == "free")


def _relative(curves: Curves, terms: int) -> Curves:
    """Return the curves less the first ``terms`` terms of their Taylor series at x = 0."""
    powers = curves.powers.copy()
    for power in range(terms):
        powers[:, power] -= curves.values([0.0], power)[0] / math.factorial(power)
    return dataclasses.replace(curves, powers=powers)


@dataclasses.dataclass(frozen=True, eq=False)
class BeamShapes(StoredPart):
    """Motion of a beam's sections, and of bodies attached to them, with the modes.

    Calling it with a position at the undeformed beam (3,) [m], body axes, returns the slopes (6, n) of a frame there,
    rotation then displacement per unit amplitude, and its stiffening (3, n, n), or None: the displacement has the
    second-order part -1/2 eta* G_c eta along axis c. A frame beside the axis, or beyond an end, moves with the section.
    """

    curves: tuple[Curves, Curves, Curves, Curves]  # in the order of DIRECTIONS
    stiffening: bool
    nodes: np.ndarray  # of Gauss's rule between 0 and 1
    weights: np.ndarray

    @property
    def count(self) -> int:
        return sum(len(curves.rates) for curves in self.curves)

    def section(self, x: Any) -> np.ndarray:
        """Return rotation and displacement of the sections at ``x`` [point] per amplitude: [point, 6, mode]."""
        x = np.asarray(x, np.float64)
        out, first = np.zeros((len(x), 6, self.count)), 0
        for direction, curves in zip(DIRECTIONS, self.curves, strict=True):
            at = slice(first, first := first + len(curves.rates))
            for row, sign, derivative in MOVES[direction]:
                out[:, row, at] = sign * curves.values(x, derivative)
        return out

    def foreshortening(self, x: float) -> np.ndarray:
        """Return int_0^x of v_s v_s* + w_s w_s* ds [1/m] [mode, mode]."""
        turns = self.section(x * self.nodes)[:, 1:3]
        return np.einsum("s,sci,scj->ij", x * self.weights, turns, turns)

    def __call__(self, position: Any) -> tuple[np.ndarray, np.ndarray | None]:
        position = checked_array("modes.shape", "position [m]", position, (3,))
        x = float(np.clip(position[0], 0.0, self.curves[0].length))  # beyond an end, all moves with the end
        (slopes,), arm = self.section([x]), position - (x, 0.0, 0.0)
        turn = slopes[:3].copy()
        slopes[3:] += np.cross(turn, arm[:, None], axis=0)
        if not self.stiffening:
            return slopes, None
        along = np.einsum("ci,j->cij", turn, arm @ turn)  # of exp(turn eta) arm
        second = np.einsum("c,ij->cij", arm, turn.T @ turn) - 0.5 * (along + along.swapaxes(1, 2))
        second[0] += self.foreshortening(x)
        return slopes, second


def beam_modes(
    length: float,
    section: Section,
    material: Material,
    ends: str = "clamped",
    count: int | Mapping[str, int] = 2,
    *,
    children: Mapping[Any, Any] | None = None,
    stiffening: bool = True,
    damping_ratio: float = 0.0,
    rotary: bool = True,
    points: int | None = None,
) -> Modes:
    """Return the modal data of a straight uniform beam along the body's x axis, from the body frame's origin.

    ``spo.Body(*modes.rigid, modes=modes)`` is the body. The modes are, in this order, bending along y, bending along
    z, torsion and stretch; their stiffness is diagonal. The body frame moves with the section at x = 0, for all
    three kinds of shapes.

    Args:
        length: L [m].
        section: the cross-section, in the body's y and z.
        material: density and moduli.
        ends: "clamped": eigenfunctions of the beam clamped at x = 0 and free at L, for arms and booms that carry little
            at their tips. "free": eigenfunctions of the free beam, less their displacement and slope at x = 0, for
            bodies that float; with a free hinge their frequencies are exact. "element": the static shapes of a beam
            loaded at its tip, for chains of beams and for beams that carry much; exact for forces and moments at the
            tip.
        count: how many modes: an integer for each of the two bending planes, or by direction, such as
            ``{"y": 3, "z": 3, "torsion": 1, "axial": 1}``. An element has up to 2, 2, 1 and 1.
        children: where hinges sit that carry other bodies: label or index of the child, and the distance along
            the beam [m] or the position in the undeformed beam (x, y, z) [m], body axes.
        stiffening: whether points and children move along the beam as it bends (foreshortening), a term of second order
            in the amplitudes. Without it a beam that spins fast diverges, and chains of beams converge to wrong shapes.
        damping_ratio: zeta of every mode: its damping is 2 zeta sqrt(stiffness mass).
        rotary: whether sections have inertia about y and z (Rayleigh). False (Euler and Bernoulli) makes calls a little
            faster and suits slender beams: frequencies of bending rise by about (pi r k / L)^2 / 2 for mode k, r being
            the section's radius of gyration, and the moments of inertia about y and z lack m r^2. Shear deformation,
            which is left out, matters two to three times as much as rotary inertia.
        points: number of mass points. Fewer make the calls faster: modal mass and coupling are then sums over the
            points. By default the fewest that give all sums to 1e-10.

    An eigenfunction or an element's shape is 1 at x = L, so that amplitudes of "clamped" and "element" modes are
    displacements [m] and angles [rad] of the tip.

    The mass sits at Gauss points of the axis, as few as give modal mass, coupling and stiffening to 1e-10; twisting
    sections have their inertia beside. ``modes.shape`` gives the slopes anywhere on the beam.

    Raises:
        ValueError: a value is out of range; the message names it.
        TypeError: ``section``, ``material`` or ``children`` is something else.
    """
    length, zeta, counts, number = _check_options(
        length, section, material, ends, count, children, damping_ratio, points
    )
    total = material.density * section.area * length
    y, z = (_bending(length, counts[name], ends) for name in ("y", "z"))
    torsion, axial = (_rod(length, counts[name], ends) for name in ("torsion", "axial"))
    shapes = BeamShapes((y, z, torsion, axial), bool(stiffening), *_gauss(FINE + 3 * max(counts.values())))
    particles = _points(length, total, shapes, number)

    x, weights = length * shapes.nodes, length * shapes.weights
    stiffness = _stiffness(section, material, shapes, x, weights)
    mass, coupling = _moments(particles)
    turning = material.density * np.array([section.Iy + section.Iz, section.Iy, section.Iz]) * (1.0, rotary, rotary)
    turns = shapes.section(x)[:, :3]
    mass += np.einsum("s,c,sci,scj->ij", weights, turning, turns, turns)
    coupling[:3] += np.einsum("s,c,sci->ci", weights, turning, turns)
    damping = 2.0 * zeta * np.sqrt(stiffness * np.diagonal(mass))

    slopes, stiffenings = {}, {}
    for child, place in (children or {}).items():
        slopes[child], second = shapes(_on_the_beam(child, place, length))
        if second is not None:
            stiffenings[child] = second
    inertia = length * turning + total * length**2 / 12.0 * np.array([0.0, 1.0, 1.0])
    return Modes(
        mass=mass,
        stiffness=stiffness,
        damping=damping,
        coupling=coupling,
        slopes=slopes,
        stiffening=stiffenings or None,
        points=particles,
        rigid=(total, (0.5 * length, 0.0, 0.0), np.diag(inertia)),
        shape=shapes,
    )


def _check_options(
    length: float, section: Any, material: Any, ends: str, count: Any, children: Any, damping_ratio: Any, points: Any
) -> tuple[float, float, dict[str, int], int | None]:
    """Return the length, the damping ratio, the numbers of modes by direction and of points; errors by name."""
    (length,) = positive("beam_modes", length=length)
    for name, value, kind in (("section", section, Section), ("material", material, Material)):
        if not isinstance(value, kind):
            raise TypeError(f"beam_modes: {name} is {value!r}; expected a spo.{kind.__name__}")
    if ends not in ENDS:
        raise ValueError(f"beam_modes: ends is {ends!r}; expected one of {', '.join(map(repr, ENDS))}")
    zeta = float(checked_array("beam_modes", "damping_ratio", damping_ratio, ()))
    if zeta < 0.0:
        raise ValueError(f"beam_modes: damping_ratio is {zeta}; expected zero or more")
    counts = _counts(count, ends)
    if children is not None and not isinstance(children, Mapping):
        raise TypeError(f"beam_modes: children is {children!r}; expected places by label or index of the child")
    number = as_integer(points)
    if points is not None and (number is None or number < 2):
        raise ValueError(f"beam_modes: points is {points!r}; expected an integer of two or more, or None")
    return length, zeta, counts, number


def _stiffness(
    section: Section, material: Material, shapes: BeamShapes, x: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Return the stiffness of each mode: bending along y and z, torsion, stretch, from curvatures at places x."""
    curvatures = [curves.values(x, 2 if i < 2 else 1) for i, curves in enumerate(shapes.curves)]
    E, G = material.E, float(material.G)  # type: ignore[arg-type]
    rigidities = (E * section.Iz, E * section.Iy, G * section.torsion, E * section.area)  # type: ignore[operator]
    return np.concatenate([rigidity * weights @ bend**2 for rigidity, bend in zip(rigidities, curvatures, strict=True)])


def _counts(count: Any, ends: str) -> dict[str, int]:
    """Return the number of modes by direction."""
    if isinstance(count, Mapping):
        unknown = [name for name in count if name not in DIRECTIONS]
        if unknown:
            raise ValueError(f"beam_modes: count has {unknown[0]!r}; expected some of {', '.join(DIRECTIONS)}")
        given = dict(count)
    else:
        given = {"y": count, "z": count}
    counts = {}
    for name in DIRECTIONS:
        number = as_integer(given.get(name, 0))
        if number is None or number < 0:
            raise ValueError(f"beam_modes: count is {count!r}; expected integers, zero or more")
        if ends == "element" and number > MOST_OF_AN_ELEMENT[name]:
            raise ValueError(
                f"beam_modes: count is {count!r}; an element has at most {MOST_OF_AN_ELEMENT}; "
                "take more elements, or ends='clamped'"
            )
        counts[name] = number
    if not any(counts.values()):
        raise ValueError(
            f"beam_modes: count is {count!r}; expected at least one mode; leave modes out for a rigid body"
        )
    return counts


def _on_the_beam(child: Any, place: Any, length: float) -> np.ndarray:
    """Return a child's position in the undeformed beam."""
    name = f"the place of child {child!r} [m]"
    if np.ndim(place) == 0:
        place = (float(checked_array("beam_modes", name, place, ())), 0.0, 0.0)
    position = checked_array("beam_modes", name, place, (3,))
    if not 0.0 <= position[0] <= length * (1.0 + 1e-12):
        raise ValueError(f"beam_modes: {name} is {position.tolist()}; expected x between 0 and the length, {length} m")
    return position


def _gauss(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of Gauss's rule on 0 to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return read_only(0.5 * (nodes + 1.0)), read_only(0.5 * weights)


def _points(length: float, mass: float, shapes: BeamShapes, number: int | None) -> MassPoints:
    """Return so many Gauss points, or the fewest whose integrals are those of very many, up to ``QUADRATURE``."""

    def placed(nodes: np.ndarray, weights: np.ndarray) -> MassPoints:
        x = length * nodes
        second = np.zeros((len(x), 3, shapes.count, shapes.count))
        second[:, 0] = [shapes.foreshortening(at) for at in x]
        position = np.stack([x, 0.0 * x, 0.0 * x], axis=1)
        return MassPoints(mass * weights, position, shapes.section(x)[:, 3:], second if shapes.stiffening else None)

    if number is not None:
        return placed(*_gauss(number))
    truth = _integrals(placed(shapes.nodes, shapes.weights))
    for number in range(2, len(shapes.nodes)):
        found = placed(*_gauss(number))
        errors = [
            np.abs(a - b).max() / np.abs(b).max() for a, b in zip(_integrals(found), truth, strict=True) if b.any()
        ]
        if max(errors) <= QUADRATURE:
            break
    return found


def _integrals(points: MassPoints) -> list[np.ndarray]:
    """Return what the mass points should integrate well: inertia, modal mass, coupling, centrifugal stiffness."""
    mass, position = points.mass, points.position[:, 0]
    integrals = [mass @ position**2, *_moments(points)]
    if points.stiffening is not None:
        integrals.append(np.einsum("s,s,sij->ij", mass, position, points.stiffening[:, 0]))
    return integrals


def _moments(points: MassPoints) -> tuple[np.ndarray, np.ndarray]:
    """Return modal mass (n, n) and coupling (6, n) of mass points."""
    mass = np.einsum("s,sci,scj->ij", points.mass, points.shapes, points.shapes)
    moments = np.cross(points.position[:, :, None], points.shapes, axis=1)
    return mass, np.einsum("s,sci->ci", points.mass, np.concatenate([moments, points.shapes], axis=1))
