"""The stress cases as data: scene, parameters, and the law, which is the error to be expected.

A law is written for float32 and scales with eps. An error of more than ``ALLOWED`` times the law fails.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from . import scenes
from .scenes import Problem

EPS32, EPS64 = 2.0**-23, 2.0**-52
ALLOWED = 10.0


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """One case of the suite.

    Args:
        name: such as "S1.chain_rand".
        build: function of ``parameters`` that returns the problem.
        formula: the law as it is printed.
        law: the law as a function of eps, the parameters, and two functions that return an array by world: ``cond``,
            the condition of the mass matrix, and ``D_cond``, the largest condition of a hinge's block of D.
        source: section of the stress suite that states the law.
        quantity: "qdd", "pivots" (D), "root_pivot" (D of dof 0), "log_det" or "dense" (qdd from the library's mass
            matrix by a dense Cholesky in the same precision, whose breakdown counts as an error of 1).
        metric: "norm" (2-norm of the error over that of the value), "component" (largest relative error of an entry)
            or "absolute".
        steps: refinement steps with a float64 residual before the error is measured.
        contrast: names of forms of :mod:`contrast` that are measured beside it.
        words: precision -> the status word that every world must have in it. In other precisions a world must have 0,
            or 3 (digits lost) where the law allows an error of more than half of the digits.
        slow: whether the case runs only when slow ones are asked for.
        precisions: those in which the case is judged by its law.
    """

    name: str
    parameters: dict
    build: Callable[..., Problem]
    formula: str
    law: Callable[..., Any]
    source: str
    quantity: str = "qdd"
    metric: str = "norm"
    steps: int = 0
    contrast: tuple[str, ...] = ()
    words: dict = dataclasses.field(default_factory=dict)
    slow: bool = False
    precisions: tuple[str, ...] = ("float32", "float64")

    @property
    def id(self) -> str:
        """Name and parameters, such as "S1.chain_rand.n16"."""
        return ".".join([self.name, *(f"{key}{_short_text(value)}" for key, value in self.parameters.items())])

    @property
    def shown(self) -> tuple[str, ...]:
        """Precisions that are measured: those with a law, and "refined" (one refinement step) for qdd."""
        extra = self.quantity == "qdd" and self.steps == 0 and self.precisions != ("float32",)
        return ("float32", "refined", "float64") if extra else self.precisions

    @property
    def reads_pivots(self) -> bool:
        """Whether the quantity is read from the recursions' memory, where only granularity "node" leaves D."""
        return self.quantity in ("pivots", "root_pivot")

    def expects(self, status: np.ndarray, dtype: str, law: np.ndarray) -> np.ndarray:
        """Return for each world whether its status word is one that it may have."""
        eps = {"float32": EPS32, "float64": EPS64}[dtype]
        if dtype in self.words:
            return status == self.words[dtype]
        return (status == 0) | ((status == 3) & (ALLOWED * law >= eps**0.5))

    @functools.cached_property
    def problem(self) -> Problem:
        """Scene and states."""
        return self.build(**self.parameters)


def _short_text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float | int) else str(value)


def flat(level: float) -> dict:
    """Return formula and law of an error that is the same for every parameter; ``level`` in float32."""
    return dict(formula=f"{level:g}", law=lambda eps, cond, **_: level * eps / EPS32)


def every(name: str, build: Callable, source: str, law: dict, values: dict, slow: Iterable = (), **more: Any) -> list:
    """Return a case for each value of the one parameter in ``values``, and a slow case for each value in ``slow``."""
    ((key, given),) = values.items()
    made = [Case(name, {key: value}, build, source=source, **law, **more) for value in given]
    return made + [Case(name, {key: value}, build, source=source, slow=True, **law, **more) for value in slow]


def by(formula: str, law: Callable) -> dict:
    """Return formula and law as arguments of a :class:`Case`."""
    return dict(formula=formula, law=law)


COND = by("1e-3 eps cond", lambda eps, cond, **_: 1e-3 * eps * cond())
CHOLESKY = by(".05 eps cond", lambda eps, cond, **_: 0.05 * eps * cond())
LENGTH = by("n eps", lambda eps, n, **_: n * eps)
HEAVY = by("max(5e-7, 2e-8 sqrt r)", lambda eps, r, **_: max(5e-7, 2e-8 * r**0.5) * eps / EPS32)
BLOCK = by("eps cond(D)", lambda eps, D_cond, **_: eps * D_cond())
OBLIQUE = by("eps / delta^2", lambda eps, delta, **_: eps / delta**2)
TILTED = by("eps / (e/I + delta^2)", lambda eps, e, delta, **_: eps / (e / max(scenes.ARM) + delta**2))
WIDE = by("eps sqrt n", lambda eps, n, **_: eps * n**0.5)


SUBNORMAL = dict(float32=4)  # inertias are as small as 1e-37 kg m^2; float32 cannot hold their products
OBLIQUE_GIMBAL = functools.partial(scenes.gimbal, oblique=True, round_arm=True)


def refined(steps: int) -> dict:
    """Return formula and law of refinement: a step multiplies the error by 1e-3 eps cond, down to float64 rounding."""
    law = lambda eps, cond, **_: (1e-3 * EPS32 * cond()) ** (steps + 1) + 1e-3 * EPS64 * cond() + EPS64  # noqa: E731
    return by(f"(1e-3 eps cond)^{steps + 1}", law)


CASES = [
    *every("S1.chain_rand", scenes.chain_rand, "S1", flat(5e-7), dict(n=(4, 16, 64, 256)), slow=(1024, 4096)),
    *every("S2.chain_grav_base", scenes.chain_gravity, "S2", flat(3e-7), dict(n=(16, 64, 256)), slow=(1024,)),
    *every("S2.chain_coriolis", scenes.chain_coriolis, "S2, few eps", flat(5e-7), dict(n=(4, 16, 64))),
    *every("S3.chain_grav_torque", scenes.chain_gravity_torque, "S3", COND, dict(n=(16, 64, 256))),
    *every("S4.crb_chol", scenes.chain_gravity_torque, "S4", CHOLESKY, dict(n=(16, 64, 256)), quantity="dense"),
    *every(
        "S5.straight_D",
        scenes.straight,
        "S5",
        flat(4 * EPS32),
        dict(n=(6, 40, 256)),
        quantity="pivots",
        metric="component",
    ),
    *every(
        "S5.straight_logdet", scenes.straight, "S5", LENGTH, dict(n=(6, 40, 256)), quantity="log_det", metric="absolute"
    ),
    *every("S7.random_coil", lambda n: scenes.chain_rand(n, 3.0), "S7", flat(5e-7), dict(n=(16, 64, 256))),
    *every("S8.binary_tree", scenes.binary_tree, "S8", flat(5e-7), dict(n=(255,)), slow=(1023,)),
    *every("S9.star", scenes.star, "S9", WIDE, dict(n=(64, 512)), quantity="root_pivot"),
    *every("S10.caterpillar", scenes.caterpillar, "S10", flat(5e-7), dict(n=(64,))),
    *every(
        "S11.heavy_tip",
        scenes.heavy_tip,
        "S11, 4.1",
        HEAVY,
        dict(r=(1e2, 1e4, 1e6, 1e8, 1e10, 1e12)),
        contrast=("square root",),
    ),
    *every("S12.light_tip", scenes.heavy_tip, "S12", flat(5e-7), dict(r=(1e-2, 1e-4, 1e-6, 1e-8, 1e-12))),
    *every(
        "S13.massless_interior",
        functools.partial(scenes.light_link, 4),
        "S13",
        flat(5e-7),
        dict(mu=(1.0, 1e-2, 1e-4, 1e-6, 1e-8, 1e-12, 0.0)),
    ),
    *every("S14.massless_distal", functools.partial(scenes.light_link, 7), "S14", flat(5e-7), dict(mu=(1e-12,))),
    *(
        Case(
            f"S15.gimbal_{label}",
            dict(e=e, delta=delta),
            scenes.gimbal,
            source="S15",
            quantity=quantity,
            contrast=("world axes",) if quantity == "root_pivot" else (),
            **flat(1e-6),
        )
        for label, quantity in (("D0", "root_pivot"), ("qdd", "qdd"))
        for e in (1e-2, 1e-4, 1e-6, 1e-8)
        for delta in (1e-1, 1e-2, 1e-3, 0.0)
    ),
    *(
        Case("S15.gimbal_oblique", dict(e=e, delta=delta), OBLIQUE_GIMBAL, source="S15, world axes", **TILTED)
        for e in (1e-2, 1e-4, 1e-6)
        for delta in (1e-1, 1e-2, 1e-3)
    ),
    *every(
        "S16.far_base",
        scenes.far_origin,
        "S16",
        flat(5e-7),
        dict(x=(0.0, 1.0, 1e2, 1e5)),
        contrast=("world origin", "subtracted offsets"),
    ),
    *every(
        "S16.far_floating",
        functools.partial(scenes.far_origin, floating=True),
        "S16",
        flat(5e-7),
        dict(x=(0.0, 1e2, 1e5)),
    ),
    *(
        case
        for label, quantity in (("D", "pivots"), ("qdd", "qdd"))
        for r in (1.0, 0.5, 0.3, 0.1)
        for case in every(
            f"S18.scale_sep_{label}",
            scenes.scale_separation,
            "S18",
            flat(1e-6),
            dict(r=(r,)),
            quantity=quantity,
            metric="component",
            words=SUBNORMAL if r == 0.1 else {},
        )
    ),
    *every("S20.stiff_delta", scenes.stiff_armature, "S20", flat(5e-7), dict(s=(0.0, 1.0, 1e3, 1e6, 1e9, 1e12))),
    *every(
        "S20.implicit_1e8", scenes.implicit_stiffness, "S20", flat(5e-7), dict(dt=(1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1))
    ),
    *every(
        "S26.ball",
        functools.partial(scenes.weak_ball, floating=False),
        "S26",
        BLOCK,
        dict(weak=(1.0, 1e-2, 1e-4, 1e-5, 1e-6)),
    ),
    *every(
        "S26.free_ball",
        functools.partial(scenes.weak_ball, floating=True),
        "S26",
        BLOCK,
        dict(weak=(1.0, 1e-2, 1e-4, 1e-5, 1e-6)),
    ),
    *every("S26.three_angles", scenes.three_angles, "S15, oblique axes", OBLIQUE, dict(delta=(1.0, 1e-1, 1e-2, 1e-3))),
    *every(
        "S30.sym_ablation",
        scenes.chain_gravity,
        "S30",
        flat(2e-7),
        dict(n=(16, 64, 256)),
        contrast=("full 6 x 6 P", "body axes, NumPy"),
        precisions=("float32",),
    ),
    *(
        case
        for steps in (0, 1, 2)
        for case in every(
            f"S33.refine_{steps}",
            scenes.chain_gravity_torque,
            "S33",
            refined(steps),
            dict(n=(16, 64, 256)),
            steps=steps,
            precisions=("float32",),
        )
    ),
    *every(
        "S34.long_logdet",
        scenes.chain_rand,
        "S34",
        LENGTH,
        dict(n=(64, 256)),
        slow=(1024,),
        quantity="log_det",
        metric="absolute",
        precisions=("float32",),  # the logarithms are added in more digits than D has
        contrast=("float32 sum",),
    ),
]


CAUSES = {
    "S18.scale_sep_qdd": "its error is measured entry by entry, and an entry of qdd that nearly cancels has the "
    "rounding error of its neighbours, 10 to 220 times the law; in float32 the median error of an entry is 4e-7, the "
    "largest error of an entry of D is 5e-7",
}
"""Case -> why it misses its law, where the cause is known and accepted."""


def choose(pattern: str, slow: bool = True) -> list[Case]:
    """Return the cases whose id has a match of the regular expression ``pattern``; ``slow``: the slow ones too.

    Raises:
        ValueError: ``pattern`` is no regular expression.
    """
    try:
        return [case for case in CASES if re.search(pattern, case.id) and (slow or not case.slow)]
    except re.error as error:
        raise ValueError(f"stress: the filter {pattern!r} is not a regular expression: {error}") from None
