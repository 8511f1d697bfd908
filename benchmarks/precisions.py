"""Precisions are data: what a case's ``dtype`` means to the runner."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import warp_spo as spo
from warp_spo.trials.operations import OPERATIONS, TOLERANCE, Inputs, Operation
from warp_spo.trials.trial import Subject

HEADLINE = ("forward_dynamics", "inverse_dynamics", "mass_matrix", "solve_mass_matrix")
REFINED = ("forward_dynamics", "solve_mass_matrix")
RANDOMISED = ("body_mass", "body_com", "body_inertia")


@dataclasses.dataclass(frozen=True)
class Precision:
    """How a scene is computed.

    Attributes:
        subject: ``subject(scene, worlds, device, granularity, inputs)``.
        operations: name -> operation, those that it has.
        tolerance: largest error that counts as correct.
        scalar: whose peak bounds it; None where two are mixed.
    """

    subject: Callable[..., Subject]
    operations: dict[str, Operation]
    tolerance: float
    scalar: str | None


def of(
    dtype: str,
    scene: spo.Scene,
    worlds: int,
    device: Any,
    granularity: str | None,
    inputs: list[Inputs],
    **options: Any,
) -> Subject:
    """A subject whose arrays are of one scalar type."""
    return Subject(spo.Dynamics(scene, worlds, device, dtype, granularity=granularity, **options), inputs)


PRECISIONS = {
    "float32": Precision(functools.partial(of, "float32"), OPERATIONS, TOLERANCE["float32"], "float32"),
    # a step takes the error of float32 once more; without it nothing is under 1e-8
    "refined": Precision(
        functools.partial(of, "float64", refine=1), {name: OPERATIONS[name] for name in REFINED}, 1e-8, None
    ),
    # inertias are inputs, as domain randomisation has them, each world's its own
    "randomised": Precision(
        functools.partial(of, "float32", variable=RANDOMISED),
        {name: OPERATIONS[name] for name in HEADLINE},
        TOLERANCE["float32"],
        "float32",
    ),
    "float64": Precision(functools.partial(of, "float64"), OPERATIONS, TOLERANCE["float64"], "float64"),
}
