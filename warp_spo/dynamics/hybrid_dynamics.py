"""Hybrid dynamics: some dofs follow prescribed accelerations, the others move under forces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..errors import UnsupportedError, refuse_masked
from ..execution.routine import Routine
from ..recursions import hybrid
from ..recursions.loops import minimal
from ..runtime import launches
from ..runtime.arrays import AnyArray, ArrayT, Call, shape_of
from ..runtime.memory import broadcast_worlds
from . import trial_inputs
from .operation import BODY_F, QD, QDD, TAU, USE_EMBED, Operation, Option, Q, Result, Trial

if TYPE_CHECKING:
    from .dynamics import Dynamics

HYBRID_DYNAMICS = Operation(
    "hybrid_dynamics",
    arguments=(
        Q,
        QD,
        TAU,
        QDD,
        Option("prescribed", default=lambda scene: [False] * scene.dof_count, sample=trial_inputs.every_other),
        BODY_F,
    ),
    results=(Result("qdd", "world, dof"), Result("tau", "world, dof")),
    routine=Routine("hybrid_dynamics", hybrid.hybrid_dynamics),
    embed=Routine("embedded_hybrid_dynamics", minimal.hybrid_dynamics),
    multipliers=USE_EMBED,
    trial=Trial(lambda dense, q, qd, tau, qdd, prescribed: dense.hybrid_dynamics(qd, tau, qdd, prescribed)[0]),
)


@HYBRID_DYNAMICS.method
def hybrid_dynamics(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray | None = None,
    tau: AnyArray | None = None,
    qdd: AnyArray | None = None,
    *,
    prescribed: AnyArray | Sequence[bool],
    body_f: AnyArray | None = None,
    out: tuple[ArrayT | None, ArrayT | None] = (None, None),
) -> tuple[ArrayT, ArrayT]:
    """Compute forward dynamics of some dofs and inverse dynamics of the others: Mass qdd + bias_force = tau.

    Prescribed dofs follow ``qdd``, whatever force that takes; the others move under ``tau``. With all dofs prescribed
    this is inverse dynamics, with none forward dynamics. A prescribed dof is not eliminated from the articulated
    inertia: P+ = P, z+ = z + P H* qdd, and its force is H f + Delta qdd. Featherstone, Rigid Body Dynamics Algorithms,
    9.2.

    Args:
        q, qd, body_f: as :meth:`forward_dynamics`.
        tau: forces of the dofs that are not prescribed [world, dof]; the other entries are not read; None means zero.
        qdd: accelerations of the prescribed dofs [world, dof]; the other entries are not read; None means zero.
        prescribed: bool, True for prescribed dofs. A list or NumPy array [dof] folds into the kernel, so that each mask
            has a kernel of its own. Arrays on the device, [world, dof] or [dof], and NumPy arrays [world, dof] are read
            at each call.
        out: (qdd, tau), each an array or None.

    Returns:
        qdd, tau [world, dof]: all entries, the given ones as they were given. A world in which the dofs that are not
        prescribed have no positive definite mass matrix is NaN.

    With embedded loops, only independent dofs can be prescribed, by a mask that folds; their tau is the force that is
    needed beside the tau of all other dofs.
    """
    engine = self._engine
    with engine.call(HYBRID_DYNAMICS) as call:
        outs = engine.outs(call, HYBRID_DYNAMICS, out)
        arrays = engine.read(call, HYBRID_DYNAMICS, q=q, qd=qd, tau=tau, qdd=qdd, body_f=body_f)
        mask, folded = _read_mask(self, call, prescribed)
        _check_prescribed(self, call, folded)
        qdd_out, tau_out = engine.write(call, HYBRID_DYNAMICS, outs, {})
        engine.launch(HYBRID_DYNAMICS, qdd_out, {"tau_out": tau_out}, **arrays, prescribed=mask, mask=folded)
    return call.result


def _read_mask(dyn: Dynamics, call: Call, mask: Any) -> tuple[wp.array | None, tuple[bool, ...] | None]:
    """Return the mask as an array [world, dof], or as a tuple of bools that folds into the kernel."""
    dofs = dyn.scene.dof_count
    if isinstance(mask, list | tuple):
        try:
            mask = np.asarray(mask, dtype=bool if len(mask) == 0 else None)
        except ValueError:
            raise ValueError(f"{call.name}: prescribed is {mask!r}; expected bools, one for each dof") from None
    refuse_masked(call.name, "prescribed", mask)
    if isinstance(mask, np.ndarray) and mask.ndim == 1:
        if mask.shape != (dofs,) or mask.dtype != bool:
            raise ValueError(
                f"{call.name}: prescribed is {mask.dtype} {mask.shape}; expected bool ({dofs},) [dof] or "
                f"({dyn.worlds}, {dofs}) [world, dof]"
            )
        return None, tuple(mask.tolist())
    if not hasattr(mask, "shape") or len(shape_of(mask)) != 1:
        return call.read("prescribed", mask, (dyn.worlds, dofs), "[world, dof] or [dof]", dtype=wp.bool), None
    shared = call.read("prescribed", mask, (dofs,), "[world, dof] or [dof]", dtype=wp.bool)
    spread_mask = dyn._mask
    if shared.size:
        launches.copy(spread_mask, broadcast_worlds(shared.reshape((1, dofs)), 0, dyn.worlds))
    return spread_mask, None


def _check_prescribed(dyn: Dynamics, call: Call, folded: tuple[bool, ...] | None) -> None:
    """With embedded loops, only independent dofs can be prescribed, and a kernel is made for each mask."""
    if dyn.embedding is None:
        return
    if folded is None:
        what = "a mask on the device, or one for each world, with loops='embed'"
        raise UnsupportedError(call.name, what, "pass a list or a NumPy array [dof]")
    labels = dyn.scene.dof_labels
    wrong = [labels[dof] for dof, on in enumerate(folded) if on and dof not in dyn.embedding.dofs]
    if wrong:
        what = f"prescribing {', '.join(wrong)}, which the loops make follow other dofs"
        raise UnsupportedError(call.name, what, "name them in Dynamics(independent=...)")
