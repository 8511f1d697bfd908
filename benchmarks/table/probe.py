"""Time operations of the ``warp_spo`` that Python finds: ``python probe.py CASES.json OUT.json [DEVICE]``.

This file imports nothing of this folder and uses the public surface alone, so that one text measures every commit. A
case is a dictionary with ``scene``, ``urdf`` (a file), ``floating``, ``op``, ``worlds`` and ``dtype``. Rows are cases
with ``us``, the median run time of a call of all worlds; a case that fails has ``skipped``, the reason.
"""

import json
import sys
import time

import numpy as np
import warp as wp

DT = 2e-3  # [s]
KE, KD = 200.0, 20.0  # drives of a step [N m/rad, N m s/rad]
FEET = "ankle_roll_link"  # how labels of the bodies end at which the inertia is asked for
ROW, MOST_CALLS = 3e-3, 256  # calls that are timed together take so long [s], or are so many
REPEATS, WARM_UP = 15, 0.1  # timed rows; time of calls before them [s]


def call_of(case, spo, device):
    """Return a function that launches a case, and the arrays that it writes."""
    if case["op"] == "solver_step":
        return solver_call(case, device)
    scene = spo.load(case["urdf"], floating=case["floating"])
    if case["op"] == "step":
        driven = np.concatenate([np.full(hinge.dof_count, hinge.kind != "free") for hinge in scene.hinges])
        scene = scene.with_values(joint_target_ke=KE * driven, joint_target_kd=KD * driven)
    worlds, rng = case["worlds"], np.random.default_rng(0)
    dyn = spo.Dynamics(scene, worlds, device, case["dtype"])
    array = lambda value: wp.array(value, dtype=dyn.dtype, device=device)  # noqa: E731
    bounds = [np.clip(scene.values[f"joint_limit_{end}"][0], -1.0, 1.0) for end in ("lower", "upper")]
    low, high = np.minimum(*bounds), np.maximum(*bounds)
    away = 0.5 * (low + high) + 0.9 * (high - low) * rng.uniform(-0.5, 0.5, (worlds, scene.dof_count))
    q = dyn.integrate(array(np.tile(scene.neutral_q, (worlds, 1))), array(away), 1.0)
    qd, tau = (array(rng.normal(size=away.shape)) for _ in range(2))
    if case["op"] == "step":
        out = wp.empty_like(q), wp.empty_like(qd)
        return (lambda: dyn.step(q, qd, None, DT, out=out)), list(out)
    if case["op"] == "mass_matrix":
        mass = dyn.mass_matrix(q)
        return (lambda: dyn.mass_matrix(q, out=mass)), [mass]
    if case["op"] == "operational_inertia_inverse":
        feet = [label for label in scene.body_labels if label.endswith(FEET)]
        inverse = dyn.operational_inertia_inverse(q, feet)
        return (lambda: dyn.operational_inertia_inverse(q, feet, out=inverse)), [inverse]
    result = wp.empty_like(qd)
    call = getattr(dyn, case["op"])
    return (lambda: call(q, qd, tau, out=result)), [result]


def solver_call(case, device):
    """Return a function that launches SolverSPO's step of a Newton model with drives, and the arrays that it writes."""
    import newton

    from warp_spo.newton import SolverSPO

    one, many = newton.ModelBuilder(), newton.ModelBuilder()
    one.add_urdf(case["urdf"], floating=case["floating"])
    dofs = len(one.joint_target_ke)
    one.joint_target_ke[:], one.joint_target_kd[:] = [KE] * dofs, [KD] * dofs
    one.joint_target_mode[:] = [int(newton.JointTargetMode.POSITION)] * dofs
    many.replicate(one, case["worlds"])
    model = many.finalize(device=device)
    solver, now, after, control = SolverSPO(model), model.state(), model.state(), model.control()
    low, high = model.joint_limit_lower.numpy(), model.joint_limit_upper.numpy()
    anywhere = low + (high - low) * np.random.default_rng(0).uniform(0.05, 0.95, (2, len(low)))
    start, control.joint_target_q = (wp.array(q, dtype=wp.float32, device=device) for q in anywhere)
    wp.copy(now.joint_q, start)
    return (lambda: solver.step(now, after, control, None, DT)), [after.joint_q, after.joint_qd]


def seconds_of(call, device):
    """Return the run times of a call [s], one for each timed row of calls."""
    for _ in range(3):
        call()
    wp.synchronize_device(device)
    start = time.perf_counter()
    call()
    wp.synchronize_device(device)
    count = int(np.clip(ROW / (time.perf_counter() - start), 1, MOST_CALLS))

    def row():
        for _ in range(count):
            call()

    if device.is_cuda:
        with wp.ScopedCapture(device) as capture:
            row()
        row = lambda: wp.capture_launch(capture.graph)  # noqa: E731
    start, times = time.perf_counter(), []
    while time.perf_counter() - start < WARM_UP:
        row()
        wp.synchronize_device(device)
    for _ in range(REPEATS):
        if device.is_cuda:
            begin, end = (wp.Event(device, enable_timing=True) for _ in range(2))
            device.stream.record_event(begin)
            row()
            device.stream.record_event(end)
            wp.synchronize_device(device)
            times.append(1e-3 * wp.get_event_elapsed_time(begin, end) / count)
        else:
            begin = time.perf_counter()
            row()
            times.append((time.perf_counter() - begin) / count)
    return times


def main(cases_file, out_file, name=None):
    """Measure the cases and write the rows."""
    wp.config.log_level = wp.LOG_WARNING
    import warp_spo as spo

    device, rows = wp.get_device(name), []
    with open(cases_file) as file:
        cases = json.load(file)
    for case in cases:
        row = {key: case[key] for key in ("scene", "op", "worlds", "dtype")}
        try:
            call, results = call_of(case, spo, device)
            low, median, high = np.percentile(seconds_of(call, device), [10, 50, 90])
            if not all(np.isfinite(result.numpy()).all() for result in results):
                raise ValueError("the result is not finite")
            row |= dict(us=1e6 * median, p10_us=1e6 * low, p90_us=1e6 * high)
        except Exception as error:  # the other cases go on
            row["skipped"] = f"{type(error).__name__}: {error}"
        rows.append(row)
    with open(out_file, "w") as file:
        json.dump(dict(package=spo.__file__, rows=rows), file)


if __name__ == "__main__":
    main(*sys.argv[1:])
