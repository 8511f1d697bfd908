"""Forward dynamics qdd = Mass^-1 (tau - bias_force) by the articulated-body recursion (eq. 1), and solves with Mass."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..trace.emission import Store
from ..trace.spatial import ZERO
from .articulated_sweeps import expand, reduce
from .newton_euler import inverse_dynamics

if TYPE_CHECKING:
    from .model.tracing import Trace


def forward_dynamics(trace: Trace, right: str = "tau", bias: bool = True) -> list[Store]:
    """out = Mass^-1 (tau - bias_force); without ``bias`` Mass^-1 times the array ``right``."""
    moves = bias and "qd" in trace.inputs
    done, rates, stores = reduce(trace, trace.vector(right), moves, bias)
    return stores + expand(trace, done, rates, trace.base_acceleration if bias else (ZERO, ZERO))


def forward_dynamics_bias_first(trace: Trace) -> list[Store]:
    """The same: velocity terms and loads become forces of the hinges first.

    No link has to keep its velocity while the sweep with P goes in and out: less to hold, at one more pass through
    the tree. Gravity stays the base's acceleration.
    """
    known = inverse_dynamics(trace, gravity=False, qdd=lambda dof: 0.0, letter="f")
    forces, tau = {item.index[0]: item.value for item in known if item.array == "out"}, trace.vector("tau")
    done, rates, sent = reduce(trace, lambda dof: tau(dof) - forces[dof], moves=False, loads=False)
    return [item for item in known if item.array != "out"] + sent + expand(trace, done, rates, trace.base_acceleration)


def forward_dynamics_and_solve(trace: Trace) -> list[Store]:
    """out = Mass^-1 (tau - bias_force), solved = Mass^-1 cotangent, by one factorisation"""
    stores = forward_dynamics(trace)
    done, rates, sent = reduce(trace, trace.vector("cotangent"), moves=False, loads=False, letters="y")
    return stores + sent + expand(trace, done, rates, (ZERO, ZERO), "b", "solved")


def solve_mass_matrix(trace: Trace) -> list[Store]:
    return forward_dynamics(trace, "b", bias=False)
