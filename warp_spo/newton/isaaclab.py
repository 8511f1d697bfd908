"""SolverSPO for Isaac Lab: what its Newton manager asks of a solver, without importing Isaac Lab.

Isaac Lab's classes are handed in, because they need a simulator to be imported::

    from isaaclab_newton.physics import NewtonManager, NewtonSolverCfg
    Manager, Cfg = adapter(NewtonManager, NewtonSolverCfg)
"""

from __future__ import annotations

import dataclasses
from typing import Any

from .solver import DEFAULT_VARIABLE, SolverSPO


@dataclasses.dataclass
class Options:
    """Fields of the configuration, as :class:`SolverSPO` takes them."""

    variable: tuple[str, ...] = DEFAULT_VARIABLE
    loops: str = "raise"
    integrator: str = "semi_implicit"
    granularity: str | None = None


def adapter(manager: Any, configuration: Any) -> tuple[type, type]:
    """A manager and its configuration, subclasses of Isaac Lab's NewtonManager and NewtonSolverCfg."""

    class NewtonSPOManager(manager):
        """Isaac Lab's manager with SolverSPO in its four slots. A state steps in place; contacts are not computed."""

        @classmethod
        def _build_solver(cls, model: Any, solver_cfg: Any) -> None:
            names = [field.name for field in dataclasses.fields(Options)]
            manager._solver = SolverSPO(model, **{name: getattr(solver_cfg, name) for name in names})
            manager._use_single_state = True
            manager._needs_collision_pipeline = False
            manager._supports_rigid_body_force_input = True

        @classmethod
        def _requires_initial_reset_before_graph_capture(cls) -> bool:
            return False  # the constructor compiles and allocates everything

    class SPOSolverCfg(Options, configuration):
        """Configuration of SolverSPO."""

        class_type = NewtonSPOManager

    return NewtonSPOManager, SPOSolverCfg
