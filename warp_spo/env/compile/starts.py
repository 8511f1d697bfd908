"""Reports of a step in the state in which an episode starts, for observations: gaps, slips, controls, their forces.

No step has led to that state. Its contact points are where q puts them, and move as qd says; the controls are those of
the action 0, which worlds remember then. Contacts have no force, and pairs of bodies do not slip. All of it is traced
into the stage that starts worlds anew, in a branch that only these take.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from ...errors import quoted
from ...recursions import kinematics
from ...recursions.contact.law import slip_speed
from ...recursions.contact.points import place_points
from ...recursions.model.links import Links
from ...recursions.model.tracing import Trace
from ...recursions.step.actuation import actuator_force
from ...recursions.step.joint_laws import JointLaws
from ...scene.frames import check_frames, origins
from ...trace.functions import AbstractScalar
from ...trace.scalars import Graph, Value, less, select
from ..drawn_values import POSES
from ..world import Frame, World
from .memory_layout import NET_TARGETS
from .vectors import as_value, vector

MOVED = ("contact_gap", "contact_slip")  # reports that follow from the state
CONTROLS = ("ctrl", "tau", "target_q")


class StateGraph(Graph):
    """The graph of a stage as a recursion sees it that is traced there: its inputs are values of the stage.

    Args:
        graph: of the stage. read: returns an input by array and index.
    """

    def __init__(self, graph: Graph, read: Callable[..., Value]):
        super().__init__()
        self._graph, self._read = graph, read

    def input(self, array: str, *index: int) -> Any:
        """Return what the stage has in the place of an element of an array."""
        return self._read(array, *index)

    def make(self, op: str, *args: Any) -> Any:
        """Return the scalar of an operation, in the stage's graph."""
        return self._graph.make(op, *args)


def trace_of(w: World, controls: dict[str, dict[int, Any]]) -> Trace:
    """Return a trace of the scene at the state and with the values of a world, and with its controls."""

    def read(array: str, *index: int) -> Value:
        if array in ("q", "qd"):
            return as_value(getattr(w, array)[index[0]])
        if array in controls:
            return as_value(controls[array].get(index[0], 0.0))
        return as_value(w.value(array).reshape(-1)[index[0]])

    links = Links(w.scene, w._layout.values, StateGraph(w._stage.graph, read))
    return Trace(links, "float32", ("q", "qd", *controls))


class StartWorld(World):
    """A world in a state to which no step has led: its frames are where q and qd put them when they are asked for."""

    def frame(self, name: Any) -> Frame:
        """Return a frame, as :meth:`World.frame`; ValueError where events change how joints are mounted."""
        varying = [anchors for anchors in POSES if anchors in self._layout.values]
        if varying:
            raise ValueError(
                f"World.frame: an event, a command, or an action whose force is observed reads {quoted(name)} where an "
                f"episode starts; expected no event that changes {varying[0]}, with which its pose there is not known"
            )
        held = [self._layout.frames[self._layout.frame(name)]]
        frames = check_frames(self.scene, "World.frame", held)
        pose = vector(AbstractScalar(item.value) for item in kinematics.frame_poses(trace_of(self, {}), frames))
        stores = kinematics.frame_velocities(trace_of(self, {}), origins(frames))
        rates = vector(AbstractScalar(item.value) for item in stores)
        return Frame(pose[:3], pose[3:], rates[:3], rates[3:])

    def jacobian(self, name: Any) -> np.ndarray:
        """Return a frame's Jacobian, as :meth:`World.jacobian`."""
        held = [self._layout.frames[self._layout.frame(name)]]
        frames = origins(check_frames(self.scene, "World.jacobian", held))
        found = vector(0.0 for _ in range(6 * self.scene.dof_count)).reshape(6, -1)
        for item in kinematics.jacobian(trace_of(self, {}), frames):
            found[item.index[1:]] = AbstractScalar(item.value)
        return found


def contact_reports(w: World) -> dict[tuple[str, int], Value]:
    """Return gap and slip of the scene's contact points at the state of a world, by array and entry."""
    trace = trace_of(w, {})
    for link in trace.active_links:
        trace.place(link)
    laws = JointLaws(trace.links, 0.0, trace.vector("q"), trace.vector("qd"))
    found: dict[tuple[str, int], Value] = {}
    for point in place_points(trace, laws, trace.vector("qd"), ahead=w._layout.dt):
        gap, number = point.gap, point.number
        if ("contact_gap", number) in found:  # its second surface; the first one's slip counts, as in a step
            first = found["contact_gap", number]
            found["contact_gap", number] = select(less(gap, first), gap, first)
            continue
        along = sum((n * v for n, v in zip(point.normal, point.velocity, strict=True)), 0.0)
        found["contact_gap", number] = gap
        found["contact_slip", number] = slip_speed(point, point.velocity, along)
    return found


def forces(w: World, controls: dict[str, dict[int, Any]]) -> dict[tuple[str, int], Value]:
    """Return the forces of actuators at the state of a world, by array and entry."""
    return {("actuator_force", item.index[0]): item.value for item in actuator_force(trace_of(w, controls))}


def reports(w: World, parts: Iterable[Any], wanted: set[tuple[str, int]]) -> dict[tuple[str, int], Value]:
    """Return what ``wanted`` names, (array, entry), in the state of a world whose episode starts.

    Args:
        w: the world; its memory is that of a start. parts: of the actions.
    """
    arrays, found = {array for array, _ in wanted}, dict[tuple[str, int], Value]()
    points = len(w.scene.contact_points)
    if points and any(array in MOVED and entry < points for array, entry in wanted):
        found |= contact_reports(w)
    found |= {("contact_slip", entry): 0.0 for array, entry in wanted if array == "contact_slip" and entry >= points}
    if arrays & {*CONTROLS, "actuator_force"}:
        controls: dict[str, dict[int, Any]] = {}
        at = 0
        for part in parts:
            size = len(part.labels(w.scene))
            controls.setdefault(part.array, {}).update(part.trace(w, w.action[at : at + size]))
            if part.array == NET_TARGETS:
                dofs = (int(w.scene.qd_start[hinge]) for hinge in part.hinges(w.scene))
                controls.setdefault("tau", {}).update(dict.fromkeys(dofs, 0.0))  # before its first substep
            at += size
        found |= {(array, entry): as_value(x) for array, each in controls.items() for entry, x in each.items()}
        if "actuator_force" in arrays:
            found |= forces(w, {"ctrl": controls.get("ctrl", {})})
    return {key: found[key] for key in sorted(wanted & found.keys())}
