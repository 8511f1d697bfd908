"""SolverSPO as a solver of Isaac Lab's Newton manager.

Isaac Lab's classes are arguments here, so that this library does not depend on it; its packages import without a
running simulator::

    from isaaclab_newton.physics import NewtonManager, NewtonSolverCfg
    Manager, Cfg = adapter(NewtonManager, NewtonSolverCfg)

Isaac Lab 3.0 pins Newton 1.6.1. SolverSPO needs 1.8, because earlier solvers have no observables (1.7) and models no
tendons that it could refuse: an installation of both overrides that pin, which Isaac Lab does not promise to bear.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from .solver import DEFAULT_VARIABLE, SolverSPO


@dataclasses.dataclass
class Options:
    """The options of :class:`SolverSPO` as fields of Isaac Lab's configuration."""

    variable: tuple[str, ...] = DEFAULT_VARIABLE
    loops: str = "raise"
    integrator: str = "semi_implicit"
    granularity: str | None = None
    pairs: Any = None
    tune: bool = False


def adapter(manager: Any, configuration: Any) -> tuple[type, type]:
    """Return subclasses of Isaac Lab's NewtonManager and NewtonSolverCfg whose solver is SolverSPO.

    Args:
        manager: Isaac Lab's class ``NewtonManager``.
        configuration: Isaac Lab's class ``NewtonSolverCfg``.

    Returns:
        The manager's class and the configuration's class.
    """

    class NewtonSPOManager(manager):
        """Isaac Lab's manager with SolverSPO. It steps one state in place; contacts with the ground are its own."""

        @classmethod
        def _build_solver(cls, model: Any, solver_cfg: Any) -> None:
            names = [field.name for field in dataclasses.fields(Options)]
            manager._solver = SolverSPO(model, **{name: getattr(solver_cfg, name) for name in names})
            manager._use_single_state = True
            manager._needs_collision_pipeline = False
            manager._supports_rigid_body_force_input = True

        @classmethod
        def _requires_initial_reset_before_graph_capture(cls) -> bool:
            return False  # the solver's constructor has compiled and allocated everything

    class SPOSolverCfg(Options, configuration):
        """Configuration of SolverSPO."""

        class_type = NewtonSPOManager

    return NewtonSPOManager, SPOSolverCfg
