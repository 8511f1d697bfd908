"""Why learning has made a policy that is not finite."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from rsl_rl.algorithms import PPO


class NotFiniteError(FloatingPointError):
    """Learning has made a policy that is not finite; the message names the terms of the loss."""


def find_term(alg: PPO, restore: Callable[[], None]) -> str:
    """Return what made a policy not finite, by rsl_rl's own update from the same rollout.

    It ends at the first gradient that is not finite, whose terms of the loss are named.

    Args:
        alg: as it was before the update. restore: makes it that again.
    """

    def look(optimizer: Any, *_: Any) -> None:
        gradients = [w.grad for group in optimizer.param_groups for w in group["params"] if w.grad is not None]
        if not bool(torch.stack(torch._foreach_norm(gradients, math.inf)).isfinite().all()):
            raise FloatingPointError

    hook = alg.optimizer.register_step_pre_hook(look)
    try:
        PPO.update(alg)
    except FloatingPointError as error:
        terms = loss_terms(error)
        bad = [name for name, value in terms.items() if not math.isfinite(value)]
        others = "the loss of another process" if alg.is_multi_gpu else "the gradient of a finite loss"
        return f"loss {', '.join(bad)} not finite" if bad else f"{others} is not finite"
    finally:
        hook.remove()
        restore()
    return "observations that are not finite reached the normalisers"


def loss_terms(error: BaseException) -> dict[str, float]:
    """Return the terms of the loss where an error interrupted rsl_rl's ``PPO.update``, by their names in the log."""
    frame = error.__traceback__
    while frame is not None:
        found = frame.tb_frame.f_locals
        if "surrogate_loss" in found:
            names = {"surrogate": "surrogate_loss", "value": "value_loss", "entropy": "entropy"}
            return {name: float(found[local].detach().mean()) for name, local in names.items()}
        frame = frame.tb_next
    return {}
