"""A million random states of G1 thrown on the ground at 10 ms for one second: what is lost, and what gains energy.

    python -m benchmarks.contact.throws [--device cuda:0] [--worlds 1048576] [--passes 3 4] [--json FILE]

Energy is kinetic, that of gravity, k p^2 / 2 of contacts and position limits, and that of drives up to their effort
limits; once without drives, once with them. A world whose state is not finite must have a status that says so.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import warp as wp

import warp_spo as spo

from .. import command_line
from . import scenes

DT, SECONDS, CHUNK = 1e-2, 1.0, 2**17
BOUNDS = (1e-5, 1e-3, 1e-2)  # of the energy at the start


def states(scene: spo.Scene, worlds: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd [world, ...]: any attitude, 0.6 to 1.2 m high, joints within their limits, up to some rad/s."""
    rng, n = np.random.default_rng(seed), scene.dof_count
    q, qd = np.empty((worlds, scene.coord_count)), rng.normal(size=(worlds, n))
    q[:, :2], q[:, 2] = 0.0, rng.uniform(0.6, 1.2, worlds)
    turns = rng.normal(size=(worlds, 4))
    q[:, 3:7] = turns / np.linalg.norm(turns, axis=1)[:, None]
    low, high = scene.values["joint_limit_lower"][0, 6:], scene.values["joint_limit_upper"][0, 6:]
    q[:, 7:] = rng.uniform(np.maximum(low, -3.1), np.minimum(high, 3.1), (worlds, n - 6))
    qd *= np.r_[np.ones(3), 2.0 * np.ones(3), 3.0 * np.ones(n - 6)]
    return q.astype(np.float32), qd.astype(np.float32)


def energies(torch, dyn: spo.Dynamics, values: dict, target, q, qd, gap):
    """Return the energy of each world, a tensor in float64."""
    found = (dyn.kinetic_energy(q, qd) + dyn.potential_energy(q)).double()
    found += 0.5 * (values["k"] * (-gap).clamp(min=0.0) ** 2).sum(1).double()
    x = q[:, 7:]
    over = torch.maximum(values["low"] - x, x - values["high"]).clamp(min=0.0)
    found += 0.5 * (values["limit"] * over**2).sum(1).double()
    error = (x - target[:, 7:]).abs()
    line, bent = 0.5 * values["ke"] * error**2, values["effort"] * (error - 0.5 * values["ends"])
    return found + torch.where(error <= values["ends"], line, bent).sum(1).double()


def throw(scene: spo.Scene, worlds: int, passes: int, device: str, seed: int) -> dict[str, float]:
    """Return counts of one chunk of worlds, and how long its steps took."""
    import torch

    where = torch.device("cpu" if device == "cpu" else device)
    dyn = spo.Dynamics(scene, worlds, device=device)
    q, qd = (torch.tensor(x, device=where) for x in states(scene, worlds, seed))
    value = {name: scene.values[f"joint_{name}"][0, 6:] for name in
             ("target_ke", "effort_limit", "limit_lower", "limit_upper", "limit_ke")}  # fmt: skip
    ke, effort = value["target_ke"], value["effort_limit"]
    ends = np.divide(effort, ke, out=np.full(len(ke), 1e6), where=ke > 0.0)
    values = {name: torch.tensor(x, device=where, dtype=torch.float32) for name, x in
              dict(k=scene.values["contact_stiffness"], low=value["limit_lower"], high=value["limit_upper"],
                   limit=value["limit_ke"], ke=ke, effort=effort, ends=ends).items()}  # fmt: skip
    target = q.clone()
    gap = torch.empty((worlds, len(scene.contact_points)), device=where)
    status = torch.zeros(worlds, dtype=torch.int32, device=where)
    out, (q_next, qd_next) = (torch.empty_like(q), torch.empty_like(qd)), (q, qd)
    start = before = None
    found = {f"steps above {bound:g} E0": 0 for bound in BOUNDS}
    found |= {"steps": 0, "worlds": worlds, "not finite": 0, "not finite without status": 0, "worst rise": -np.inf,
              "steps with status CONTACT": 0}  # fmt: skip
    seen, began = torch.zeros(worlds, dtype=torch.bool, device=where), time.perf_counter()
    options, report = spo.StepOptions(passes=passes), spo.StepReport(contact_gap=gap)
    for _ in range(round(SECONDS / DT) + 1):
        dyn.step(q, qd, None, DT, target_q=target, status=status, out=out, options=options, report=report)
        energy = energies(torch, dyn, values, target, q, qd, gap)
        if before is None:
            start = energy
        else:
            rise = (energy - before) / start
            rise = torch.where(torch.isfinite(rise), rise, torch.zeros_like(rise))
            for bound in BOUNDS:
                found[f"steps above {bound:g} E0"] += int((rise > bound).sum())
            found["worst rise"] = max(found["worst rise"], float(rise.max()))
            found["steps"] += worlds
        seen |= (status != 0) & (status != int(spo.Status.CONTACT))
        found["steps with status CONTACT"] += int((status == int(spo.Status.CONTACT)).sum())
        before = energy
        q_next, qd_next = q, qd
        (q, qd), out = out, (q_next, qd_next)
    lost = ~(torch.isfinite(q).all(1) & torch.isfinite(qd).all(1))
    found["not finite"], found["not finite without status"] = int(lost.sum()), int((lost & ~seen).sum())
    return found | {"seconds": time.perf_counter() - began}


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("contact.throws", __doc__)
    parser.add_argument("--worlds", type=int, default=2**20)
    parser.add_argument("--passes", type=int, nargs="+", default=[3, 4])
    options = parser.parse_args(arguments)
    device, rows = str(wp.get_device(options.device)), {}
    driven = scenes.scene("g1")
    n = driven.dof_count
    limp = driven.with_values(joint_target_ke=np.zeros(n), joint_target_kd=np.zeros(n))
    for passes in options.passes:
        for name, scene in (("limp", limp), ("driven", driven)):
            total: dict[str, float] = {}
            chunk = min(CHUNK, options.worlds)
            for seed in range(options.worlds // chunk):
                for key, value in throw(scene, chunk, passes, device, seed).items():
                    total[key] = (
                        max(total.get(key, -np.inf), value) if key == "worst rise" else total.get(key, 0) + value
                    )
            rows[f"{name}, {passes} passes"] = total
            print(f"{name}, {passes} passes:", ", ".join(f"{key} {x:.6g}" for key, x in total.items()), flush=True)
            if options.json:
                options.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
