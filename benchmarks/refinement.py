"""float32 with one step of refinement: the equation is solved in float32, its residual is taken in float64.

    x = solve32(b);  r = b - Mass64 x;  x += solve32(r)

One more precision of forward_dynamics and solve_mass_matrix. The caller's arrays are float64; the step costs a float64
inverse dynamics, a second solve in float32, and rounding to and fro.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import warp as wp

import warp_spo as spo
from warp_spo.operations import OPERATIONS, Inputs
from warp_spo.trial import Subject


@wp.kernel(module="unique", enable_backward=False)
def round_off(x: wp.array2d[wp.float64], out: wp.array2d[wp.float32]):
    world, i = wp.tid()
    out[world, i] = wp.float32(x[world, i])


@wp.kernel(module="unique", enable_backward=False)
def widen(x: wp.array2d[wp.float32], out: wp.array2d[wp.float64]):
    world, i = wp.tid()
    out[world, i] = wp.float64(x[world, i])


@wp.kernel(module="unique", enable_backward=False)
def residual(wanted: wp.array2d[wp.float64], force: wp.array2d[wp.float64], out: wp.array2d[wp.float32]):
    """wanted - force in float64, rounded once."""
    world, dof = wp.tid()
    out[world, dof] = wp.float32(wanted[world, dof] - force[world, dof])


@wp.kernel(module="unique", enable_backward=False)
def correct(step: wp.array2d[wp.float32], out: wp.array2d[wp.float64]):
    world, dof = wp.tid()
    out[world, dof] += wp.float64(step[world, dof])


class Refined(Subject):
    """A subject whose arrays are float64, and a float32 twin that solves.

    Args:
        scene, worlds, device, granularity: as Dynamics has them; the granularity is that of every part.
        inputs: as :class:`warp_spo.trial.Subject` has them.
    """

    def __init__(self, scene: spo.Scene, worlds: int, device: Any, granularity: str | None, inputs: list[Inputs]):
        make = functools.partial(spo.Dynamics, worlds=worlds, device=device, granularity=granularity)
        super().__init__(make(scene, dtype="float64"), inputs)
        self.low = make(scene, dtype="float32")
        self._weightless = functools.partial(make, scene.with_values(gravity=(0.0, 0.0, 0.0)), dtype="float64")
        self._scratch: dict[tuple[str, str], wp.array] = {}

    @functools.cached_property
    def weightless(self) -> spo.Dynamics:
        """Its inverse dynamics at rest is Mass x."""
        return self._weightless()

    def scratch(self, name: str, dtype: str, like: wp.array) -> wp.array:
        """An array of that name and dtype, of the shape of ``like``; made once."""
        key = name, dtype
        if key not in self._scratch:
            self._scratch[key] = wp.empty(like.shape, dtype=getattr(wp, dtype), device=self.dyn.device)
        return self._scratch[key]

    def launch(self, kernel: wp.Kernel, inputs: list, out: wp.array) -> wp.array:
        wp.launch(kernel, out.shape, inputs, [out], device=self.dyn.device)
        return out

    def rounded(self, name: str, x: wp.array) -> wp.array:
        """``x`` in float32."""
        return self.launch(round_off, [x], self.scratch(name, "float32", x))

    def refine(self, q: wp.array, wanted: wp.array, force: wp.array, out: wp.array) -> None:
        """out += Mass32^-1 (wanted - force), q in float32."""
        rest = self.launch(residual, [wanted, force], self.scratch("residual", "float32", out))
        step = self.low.solve_mass_matrix(q, rest, out=self.scratch("step", "float32", out))
        self.launch(correct, [step], out)


def forward_dynamics(subject: Refined, q: wp.array, qd: wp.array, tau: wp.array, out: wp.array) -> None:
    low = [subject.rounded(name, x) for name, x in (("q", q), ("qd", qd), ("tau", tau))]
    first = subject.low.forward_dynamics(*low, out=subject.scratch("step", "float32", out))
    subject.launch(widen, [first], out)
    force = subject.dyn.inverse_dynamics(q, qd, out, out=subject.scratch("force", "float64", out))
    subject.refine(low[0], tau, force, out)


def solve_mass_matrix(subject: Refined, q: wp.array, b: wp.array, out: wp.array) -> None:
    low = [subject.rounded(name, x) for name, x in (("q", q), ("b", b))]
    first = subject.low.solve_mass_matrix(*low, out=subject.scratch("step", "float32", out))
    subject.launch(widen, [first], out)
    force = subject.weightless.inverse_dynamics(q, None, out, out=subject.scratch("force", "float64", out))
    subject.refine(low[0], b, force, out)


REFINED = {
    call.__name__: dataclasses.replace(OPERATIONS[call.__name__], call=call)
    for call in (forward_dynamics, solve_mass_matrix)
}
"""Name -> operation, for :class:`Refined` subjects."""
