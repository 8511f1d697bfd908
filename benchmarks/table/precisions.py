"""Precisions as data: how the runner computes a case of each ``dtype``."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import warp_spo as spo
from warp_spo.trials.inputs import OPERATIONS, TOLERANCE, Inputs, TrialCase
from warp_spo.trials.trial import Subject

HEADLINE = ("forward_dynamics", "inverse_dynamics", "mass_matrix", "solve_mass_matrix")
REFINED = ("forward_dynamics", "solve_mass_matrix")
RANDOMISED = ("body_mass", "body_com", "body_inertia")


@dataclasses.dataclass(frozen=True)
class Precision:
    """How a scene is computed.

    Attributes:
        subject: function of (scene, worlds, device, granularity, inputs) that makes the subject of trials.
        operations: name -> operation, of all operations that the precision has.
        tolerance: largest error that counts as correct.
        scalar: the scalar type whose measured peak bounds the speed; None where two types are mixed.
    """

    subject: Callable[..., Subject]
    operations: dict[str, TrialCase]
    tolerance: float
    scalar: str | None


def make_subject(
    dtype: str,
    scene: spo.Scene,
    worlds: int,
    device: Any,
    granularity: str | None,
    inputs: list[Inputs],
    **options: Any,
) -> Subject:
    """Return a subject whose arrays have one scalar type."""
    return Subject(spo.Dynamics(scene, worlds, device, dtype, granularity=granularity, **options), inputs)


PRECISIONS = {
    "float32": Precision(functools.partial(make_subject, "float32"), OPERATIONS, TOLERANCE["float32"], "float32"),
    # One refinement step squares float32's relative error; without the step no error is below 1e-8.
    "refined": Precision(
        functools.partial(make_subject, "float64", refine=1), {name: OPERATIONS[name] for name in REFINED}, 1e-8, None
    ),
    # Inertias differ by world, as in domain randomisation.
    "randomised": Precision(
        functools.partial(make_subject, "float32", variable=RANDOMISED),
        {name: OPERATIONS[name] for name in HEADLINE},
        TOLERANCE["float32"],
        "float32",
    ),
    "float64": Precision(functools.partial(make_subject, "float64"), OPERATIONS, TOLERANCE["float64"], "float64"),
}
