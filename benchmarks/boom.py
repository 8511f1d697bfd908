"""A slender boom that falls with a load at its tip, simulated by our flexible bodies, by Exudyn's and by Newton's rods.

An aluminium strip of 2 m hangs on a hinge at one end, carries a load at the other, and falls from rest along x; its tip
bends away from the hinge's tangent by up to 0.14 m. Each model is a function that prepares the simulation and returns
it as a :data:`Simulation`, on one core, in one thread, which writes no files.

Exudyn is no dependency: ``pip install --target FOLDER exudyn scipy``, then ``PYTHONPATH=FOLDER``.
"""

from __future__ import annotations

import contextlib
import functools
import io
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo

LENGTH, LOAD, GRAVITY = 2.0, 0.1, 9.81  # [m], [kg], [m/s^2]
HEIGHT, WIDTH, ALUMINIUM = 0.004, 0.03, spo.Material(density=2700.0, E=7e10)  # of the strip [m]; it bends along HEIGHT
AREA, INERTIA = HEIGHT * WIDTH, WIDTH * HEIGHT**3 / 12.0  # [m^2], [m^4]
LINE = ALUMINIUM.density * AREA  # mass of a metre [kg]
STEEP, STRETCH = ALUMINIUM.E * INERTIA, ALUMINIUM.E * AREA  # stiffness in bending [N m^2], along the axis [N]
SECONDS, SAMPLES = 2.0, 100  # of the simulation; places of the tip that count, beside that at the start
Simulation = Callable[[], np.ndarray]  # runs from the start and returns places of the tip [1 + SAMPLES, 2] [m]


def strip(bodies: int, ends: str, modes: int, **values: Any) -> spo.Modes:
    """Return the modes of one of so many equal pieces of the strip, bending along y; ``values`` as of beam_modes."""
    section = spo.Section.rectangle(y=HEIGHT, z=WIDTH)
    return spo.beam_modes(
        LENGTH / bodies, section, ALUMINIUM, ends, {"y": modes, **values.pop("count", {})}, rotary=False, **values
    )


def scene(bodies: int, ends: str, modes: int, **values: Any) -> spo.Scene:
    """Return the boom as a chain of flexible bodies, and the load at its tip, the last body."""
    beam, length = strip(bodies, ends, modes, **values), LENGTH / bodies
    welds = [spo.Hinge("fixed", k, k + 1, parent_pose=(length, 0, 0, 0, 0, 0, 1)) for k in range(bodies)]
    pieces = [spo.Body(*beam.rigid, modes=beam) for _ in range(bodies)]
    hinges = [spo.Hinge("revolute", -1, 0, axis=(0, 0, 1)), *welds]
    return spo.Scene([*pieces, spo.Body(LOAD)], hinges, gravity=(0.0, -GRAVITY, 0.0))


def error(path: np.ndarray, truth: np.ndarray) -> float:
    """Return the root of the mean squared distance of two paths of the tip [m], without their common start."""
    return float(np.sqrt(((path - truth)[1:] ** 2).sum(axis=1).mean()))


def steps_of_a_sample(dt: float) -> int:
    """Return how many steps of ``dt`` [s] lie between two places of the tip.

    Raises:
        ValueError: their number is not whole.
    """
    count = round(SECONDS / SAMPLES / dt)
    if count < 1 or abs(count * dt * SAMPLES / SECONDS - 1.0) > 1e-9:
        raise ValueError(f"boom: dt is {dt} s; expected an integer part of {SECONDS / SAMPLES} s")
    return count


# -- ours --------------------------------------------------------------------------------------------------------------
def ours(
    boom: spo.Scene, dt: float, dtype: str = "float64", worlds: int = 1, integrator: str = "midpoint"
) -> Simulation:
    """Return a simulation by ``Dynamics.step``; the steps to the next place of the tip replay as one graph."""
    dyn, count = spo.Dynamics(boom, worlds, "cpu", dtype), steps_of_a_sample(dt)
    start = wp.array(np.tile(boom.neutral_q, (worlds, 1)), dtype=dyn.dtype, device="cpu")
    q, qd = wp.clone(start), wp.zeros((worlds, boom.dof_count), dtype=dyn.dtype, device="cpu")
    poses: Any = dyn.body_poses(q)

    def advance() -> None:
        dyn.step(q, qd, None, dt, options=spo.StepOptions(integrator=integrator, substeps=count), out=(q, qd))
        dyn.body_poses(q, out=poses)

    advance()  # compiles
    with wp.ScopedCapture("cpu") as capture:
        advance()

    def simulate() -> np.ndarray:
        wp.copy(q, start)
        qd.zero_()
        path = [np.array([LENGTH, 0.0])]
        for _ in range(SAMPLES):
            wp.capture_launch(capture.graph)
            path.append(poses.numpy()[0, -1, :2].astype(np.float64))
        return np.array(path)

    return simulate


# -- Exudyn ------------------------------------------------------------------------------------------------------------
@functools.cache
def exudyn() -> Any:
    """Return the fast module of Exudyn.

    Raises:
        ImportError: it is missing; the message says how to install it.
    """
    sys.exudynFast = True  # type: ignore[attr-defined]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            import exudyn as module
            import exudyn.beams
            import exudyn.FEM
            import exudyn.utilities
            import scipy.sparse  # noqa: F401
    except ImportError as problem:
        raise ImportError(
            f"benchmarks.boom: Exudyn, which the truth comes from, is missing ({problem}); "
            "pip install --target FOLDER exudyn scipy, then PYTHONPATH=FOLDER"
        ) from None
    return module


def cable(elements: int, dt: float, radius: float = 0.9, **settings: Any) -> Simulation:
    """Return Exudyn's simulation with cable elements (ANCF, plane), the load on their last node."""
    exu = exudyn()
    use, mbs = exu.utilities, exu.SystemContainer().AddSystem()
    element = use.Cable2D(
        massPerLength=LINE, bendingStiffness=STEEP, axialStiffness=STRETCH, useReducedOrderIntegration=1
    )
    line = [0, 0, 0], [LENGTH, 0, 0], elements
    made = exu.beams.GenerateBeamElementsAlongLine(
        mbs, *line, element, gravity=[0, -GRAVITY, 0], groundConstraintsStart=[1, 1, 0, 0]
    )
    nodes = made["nodes"]
    mbs.AddObject(use.ObjectMassPoint2D(mass=LOAD, nodeNumber=nodes[-1]))
    marker = mbs.AddMarker(use.MarkerNodePosition(nodeNumber=nodes[-1]))
    mbs.AddLoad(use.Force(markerNumber=marker, loadVector=[0, -LOAD * GRAVITY, 0]))
    position = exu.OutputVariableType.Position
    tip = mbs.AddSensor(use.SensorNode(nodeNumber=nodes[-1], storeInternal=True, outputVariableType=position))
    return solved_by_exudyn(mbs, tip, dt, radius, **settings)


def floating_frame(
    bodies: int, ends: str, modes: int, dt: float, rotation: str = "RotationRxyz", **settings: Any
) -> Simulation:
    """Return Exudyn's simulation of a chain of bodies with modes (FFRFreducedOrder), given our mass points and shapes.

    Its mesh is our mass points and the section at the end, five nodes without mass, of which the first carries the
    load. The stiffness matrix is one that the modes reduce to ours.
    """
    exu = exudyn()
    from scipy.sparse import csr_matrix

    use, mbs = exu.utilities, exu.SystemContainer().AddSystem()
    beam, length = strip(bodies, ends, modes), LENGTH / bodies
    around = 0.01 * np.array([(0, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
    turn, move = np.split(beam.shape.section([length])[0], 2)
    at_end = [move + np.cross(turn, arm, axisa=0, axisb=0).T for arm in around]
    mesh = np.concatenate([beam.points.position, around + np.array([length, 0.0, 0.0])])
    shapes = np.concatenate([beam.points.shapes, at_end]).reshape(3 * len(mesh), -1)
    back, end = np.linalg.pinv(shapes), len(mesh) - 5
    last = mbs.AddMarker(use.MarkerBodyRigid(bodyNumber=mbs.AddObject(use.ObjectGround())))
    for k in range(bodies):
        masses = np.concatenate([beam.points.mass, [LOAD * (k == bodies - 1), 0, 0, 0, 0]])
        fem = exu.FEM.FEMinterface()
        fem.nodes, fem.modeBasis = {"Position": mesh}, {"matrix": shapes, "type": "NormalModes"}
        fem.massMatrix = csr_matrix(np.diag(np.repeat(masses, 3)))
        fem.stiffnessMatrix = csr_matrix(back.T @ np.diag(beam.stiffness) @ back)
        reduced = exu.FEM.ObjectFFRFreducedOrderInterface(fem, rigidBodyNodeType=f"NodeType.{rotation}")
        made = reduced.AddObjectFFRFreducedOrder(mbs, positionRef=[k * length, 0, 0], rotationMatrixRef=np.eye(3))
        root = mbs.AddMarker(use.MarkerNodeRigid(nodeNumber=made["nRigidBody"]))
        mbs.AddObject(use.GenericJoint(markerNumbers=[last, root], constrainedAxes=[1, 1, 1, 1, 1, int(k > 0)]))
        body = made["oFFRFreducedOrder"]
        weights = dict(meshNodeNumbers=list(range(len(mesh))), weightingFactors=masses / masses.sum())
        weight = mbs.AddMarker(use.MarkerSuperElementPosition(bodyNumber=body, **weights))
        mbs.AddLoad(use.Force(markerNumber=weight, loadVector=[0, -GRAVITY * masses.sum(), 0]))
        ring = dict(meshNodeNumbers=[end + 1, end + 2, end + 3, end + 4], weightingFactors=[0.25] * 4)
        if k < bodies - 1:
            last = mbs.AddMarker(use.MarkerSuperElementRigid(bodyNumber=body, **ring))
    what = dict(storeInternal=True, outputVariableType=exu.OutputVariableType.Position)
    tip = mbs.AddSensor(use.SensorSuperElement(bodyNumber=body, meshNodeNumber=end, **what))
    return solved_by_exudyn(mbs, tip, dt, **settings)


def solved_by_exudyn(
    mbs: Any, tip: int, dt: float, radius: float = 0.9, modified: bool = True, tol: float = 1e-6, sparse: bool = False
) -> Simulation:
    """Return the simulation of a system of Exudyn: generalized alpha, or the trapezoidal rule for ``radius`` 1."""
    exu = exudyn()
    mbs.Assemble()
    settings = exu.SimulationSettings()
    settings.solution.file.write, settings.solution.sensors.writePeriod = False, SECONDS / SAMPLES
    linear = exu.LinearSolverType
    settings.linearSolver.solverType = linear.EigenSparse if sparse else linear.EXUdense
    times = settings.timeIntegration
    times.numberOfSteps, times.endTime, times.minimumStepSize = round(SECONDS / dt), SECONDS, dt / 16.0
    times.newton.useModifiedNewton, times.generalizedAlpha.spectralRadius = modified, radius
    times.newton.relativeTolerance = times.newton.absoluteTolerance = tol
    rule = exu.DynamicSolverType.TrapezoidalIndex2 if radius == 1.0 else exu.DynamicSolverType.GeneralizedAlpha

    def simulate() -> np.ndarray:
        mbs.SolveDynamic(settings, rule, showCausingItems=False)
        return mbs.GetSensorStoredData(tip)[:, 1:3].copy()

    return simulate


# -- Newton ------------------------------------------------------------------------------------------------------------
def rod(segments: int, dt: float, iterations: int = 10, stretch: float = 1e5) -> Simulation:
    """Return the simulation of a rod of Newton by SolverVBD, in float32, replayed as a graph.

    Joints between segments are springs E I / length; ``stretch`` [N/m], softer than the strip, lets VBD converge.
    """
    import newton

    builder, length = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -GRAVITY, 0.0)), LENGTH / segments
    shape = builder.default_shape_cfg.copy()
    shape.density = 0.0
    line = newton.Rod([wp.vec3(k * length, 0.0, 0.0) for k in range(segments + 1)], radius=HEIGHT / 2.0)
    given = dict(stretch_stiffness=stretch, bend_stiffness=STEEP / length, wrap_in_articulation=False)
    bodies, joints = builder.add_rod(rod=line, cfg=shape, **given)
    for body in bodies:
        load = LOAD * (body == bodies[-1])
        mass = LINE * length + load
        com = 0.5 * length * load / mass
        across = LINE * length * (length**2 / 12.0 + com**2) + load * (0.5 * length - com) ** 2
        inertia = np.diag([across, across, 1e-4 * mass])
        builder.body_mass[body], builder.body_inv_mass[body] = mass, 1.0 / mass
        builder.body_com[body], builder.body_inertia[body] = wp.vec3(0.0, 0.0, com), wp.mat33(inertia)
        builder.body_inv_inertia[body] = wp.mat33(np.linalg.inv(inertia))
    foot = wp.transform(wp.vec3(0.0, 0.0, -0.5 * length), wp.quat_identity())
    joints.append(builder.add_joint_ball(-1, bodies[0], child_xform=foot))
    builder.add_articulation(sorted(joints))
    builder.color()
    model = builder.finalize(device="cpu")
    solver = newton.solvers.SolverVBD(model, iterations=iterations, rigid_joint_linear_ke=stretch)
    states, control, count = [model.state(), model.state()], model.control(), steps_of_a_sample(dt)
    with wp.ScopedCapture("cpu") as capture:
        for k in range(count):
            states[k % 2].clear_forces()
            solver.step(states[k % 2], states[1 - k % 2], control, None, dt)
        if count % 2:
            states[0].assign(states[1])
    start, end = wp.clone(states[0].body_q), wp.vec3(0.0, 0.0, 0.5 * length)

    def simulate() -> np.ndarray:
        wp.copy(states[0].body_q, start)
        states[0].body_qd.zero_()
        solver.reset(states[0])
        path = [np.array([LENGTH, 0.0])]
        for _ in range(SAMPLES):
            wp.capture_launch(capture.graph)
            path.append(np.array(wp.transform_point(wp.transform(*states[0].body_q.numpy()[-1]), end))[:2])
        return np.array(path)

    return simulate
