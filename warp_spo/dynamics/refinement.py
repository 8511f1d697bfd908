"""Iterative refinement: an equation is solved in float32, its residual is taken in float64 and solved for in turn.

    x = solve32(b);  r = b - Mass64 x;  x += solve32(r)

A step multiplies the error by float32's own, about 1e-3 eps cond, down to float64's or to the rounding of the result.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from ..kernels import refinement as kernels
from ..runtime import launches
from .forward_dynamics import FORWARD_DYNAMICS, write_status
from .inertia import SOLVE_MASS_MATRIX
from .inverse_dynamics import INVERSE_DYNAMICS

if TYPE_CHECKING:
    from .dynamics import Dynamics


class Refinement:
    """The refined operations of a :class:`Dynamics`, and its twin in the other precision, which shares its values.

    Args:
        dyn: float32 or float64: what its arrays are.
        steps: how many.
    """

    def __init__(self, dyn: Dynamics, steps: int):
        self.steps = steps
        other = "float64" if dyn.dtype is wp.float32 else "float32"
        granularity = dyn.granularity if dyn.plan.forced else None
        recursion = "scan" if dyn.plan.forced and dyn.plan.block_length else None
        own = dyn.scene, dyn.worlds, dyn.device, other, dyn.variable, granularity, "cut"
        twin = type(dyn)(*own, recursion=recursion)
        twin.recursions.parameters.share(dyn.recursions.parameters)
        self.narrow, self.wide = (dyn, twin) if dyn.dtype is wp.float32 else (twin, dyn)
        self._shape = dyn.worlds, dyn.scene.dof_count

    def forward_dynamics(self, q: wp.array, qd: Any, tau: Any, body_f: Any, status: Any, out: wp.array) -> None:
        """out = Mass^-1 (tau - bias_force); the status words are those of the float32 solution."""
        narrow = self.narrow
        low, high = ({name: self._convert(dyn, name, x) for name, x in (("q", q), ("qd", qd), ("body_f", body_f))}
                     for dyn in (narrow, self.wide))  # fmt: skip
        right, x = self._convert(narrow, "tau", tau), self._array(narrow, "x")
        swept = narrow._engine.launch(FORWARD_DYNAMICS, x, tau=right, **low)
        if status is not None:
            found = low["q"], low["qd"], right, low["body_f"], x, status
            write_status(narrow, *found, factored=swept, refined=self.steps)
        self._refine(low["q"], x, tau, out, **high)

    def solve_mass_matrix(self, q: wp.array, b: wp.array, out: wp.array) -> None:
        """out = Mass^-1 b, [world, dof], or column by column [world, dof, columns]."""
        if b.ndim == 3:
            column, found = (self._array(self.narrow if b.dtype is wp.float32 else self.wide, name)
                             for name in ("column", "found"))  # fmt: skip
            for j in range(b.shape[2]):
                launches.copy(column, b[:, :, j])
                self.solve_mass_matrix(q, column, found)
                launches.copy(out[:, :, j], found)
            return
        low, x = self._convert(self.narrow, "q", q), self._array(self.narrow, "x")
        self.narrow._engine.launch(SOLVE_MASS_MATRIX, x, q=low, b=self._convert(self.narrow, "b", b))
        self._refine(low, x, b, out, q=self._convert(self.wide, "q", q), gravity=False)

    def _refine(self, at: wp.array, x: wp.array, right: Any, out: wp.array, **given: Any) -> None:
        """out = x + corrections; ``at`` is q in float32, ``given`` what float64's inverse dynamics takes."""
        total = out if out.dtype is wp.float64 else self._array(self.wide, "total")
        force = self._array(self.wide, "force")
        rest, step = self._array(self.narrow, "rest"), self._array(self.narrow, "step")
        self._launch(kernels.cast(wp.float32, wp.float64), [x], total)
        for _ in range(self.steps):
            self.wide._engine.launch(INVERSE_DYNAMICS, force, qdd=total, **given)
            self._launch(kernels.residual(out.dtype, wp.float64, wp.float32), [right, force], rest)
            self.narrow._engine.launch(SOLVE_MASS_MATRIX, step, q=at, b=rest)
            self._launch(kernels.add(), [step], total)
        if total is not out:
            self._launch(kernels.cast(wp.float64, wp.float32), [total], out)

    def _convert(self, dyn: Dynamics, name: str, x: Any) -> Any:
        """Return ``x`` in the precision of ``dyn``: itself, or a scratch array."""
        if x is None or x.dtype is dyn.dtype:
            return x
        other = dyn.recursions.array(f"refined {name}", *x.shape)
        flat = x.shape[0], x.size // x.shape[0]
        types: tuple[Any, Any] = x.dtype, dyn.dtype
        self._launch(kernels.cast(*types), [x.reshape(flat)], other.reshape(flat))
        return other

    def _array(self, dyn: Dynamics, name: str) -> wp.array:
        return dyn.recursions.array(f"refined {name}", *self._shape)

    @staticmethod
    def _launch(kernel: wp.Kernel, inputs: list, out: wp.array) -> None:
        launches.launch(kernel, out.shape, inputs, [out], device=out.device)
