"""Cross-sections and materials of beams."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

from ..checks import checked_array
from ..pickling import StoredPart


def positive(call: str, **values: Any) -> list[float]:
    """Return numbers as floats.

    Raises:
        ValueError: one is not a finite number greater than zero.
    """
    found = [float(checked_array(call, name, value, ())) for name, value in values.items()]
    for name, value in zip(values, found, strict=True):
        if value <= 0.0:
            raise ValueError(f"{call}: {name} is {value}; expected a number greater than zero")
    return found


@dataclasses.dataclass(frozen=True, eq=False)
class Section(StoredPart):
    """The cross-section of a beam, its y and z axes principal axes through the centroid.

    Args:
        area: [m^2].
        Iy: integral of z^2 over the area [m^4], which resists bending along z.
        Iz: integral of y^2 over the area [m^4], which resists bending along y.
        torsion: Saint-Venant's constant J [m^4], G J being the torque per twist per length; by default Iy + Iz, which
            is right for circles and tubes alone.

    Raises:
        ValueError: a value is not greater than zero.
    """

    area: float
    Iy: float
    Iz: float
    torsion: float | None = None

    def __post_init__(self) -> None:
        given = {"area": self.area, "Iy": self.Iy, "Iz": self.Iz}
        given["torsion"] = _default(self.torsion, lambda: self.Iy + self.Iz)
        for name, value in zip(given, positive("Section", **given), strict=True):
            object.__setattr__(self, name, value)

    @classmethod
    def rectangle(cls, y: float, z: float) -> Section:
        """Return a solid rectangle with sides ``y`` and ``z`` [m] along the body's y and z axes.

        Its torsion constant is Saint-Venant's series, a b^3 (1/3 - 64 b / (pi^5 a) sum tanh(k pi a / 2 b) / k^5) over
        odd k, with a >= b (Timoshenko and Goodier, Theory of Elasticity, sec. 109).
        """
        y, z = positive("Section.rectangle", y=y, z=z)
        a, b = max(y, z), min(y, z)
        series = sum(math.tanh(0.5 * k * math.pi * a / b) / k**5 for k in range(1, 60, 2))
        torsion = a * b**3 * (1.0 / 3.0 - 64.0 * b / (math.pi**5 * a) * series)
        return cls(y * z, y * z**3 / 12.0, z * y**3 / 12.0, torsion)

    @classmethod
    def circle(cls, radius: float) -> Section:
        """Return a solid circle of this radius [m]."""
        (radius,) = positive("Section.circle", radius=radius)
        moment = 0.25 * math.pi * radius**4
        return cls(math.pi * radius**2, moment, moment)

    @classmethod
    def tube(cls, radius: float, wall: float) -> Section:
        """Return a circular tube with this outer radius and wall thickness [m]."""
        radius, wall = positive("Section.tube", radius=radius, wall=wall)
        if wall > radius:
            raise ValueError(f"Section.tube: wall is {wall} m; expected at most the outer radius, {radius} m")
        inner = radius - wall
        moment = 0.25 * math.pi * (radius**4 - inner**4)
        return cls(math.pi * (radius**2 - inner**2), moment, moment)


@dataclasses.dataclass(frozen=True, eq=False)
class Material(StoredPart):
    """An isotropic elastic material.

    Args:
        density: [kg/m^3].
        E: Young's modulus [Pa].
        G: shear modulus [Pa]; by default E / (2 (1 + nu)).
        nu: Poisson's ratio, from which G follows; by default 0.3. Give G or nu.

    Raises:
        ValueError: a modulus or the density is not greater than zero, nu is not between -1 and 0.5, or both G and nu
            are given.
    """

    density: float
    E: float
    G: float | None = None
    nu: float | None = None

    def __post_init__(self) -> None:
        if self.G is not None and self.nu is not None:
            raise ValueError("Material: G and nu are both given; expected one of them; the other follows")
        density, modulus = positive("Material", density=self.density, E=self.E)
        nu = 0.3 if self.nu is None else float(checked_array("Material", "nu", self.nu, ()))
        if not -1.0 < nu <= 0.5:
            raise ValueError(f"Material: nu is {nu}; expected more than -1 and at most 0.5")
        (shear,) = positive("Material", G=_default(self.G, lambda: modulus / (2.0 * (1.0 + nu))))
        nu = modulus / (2.0 * shear) - 1.0
        for name, value in {"density": density, "E": modulus, "G": shear, "nu": nu}.items():
            object.__setattr__(self, name, value)


def _default(value: Any, otherwise: Callable[[], float]) -> Any:
    return otherwise() if value is None else value
