"""Cost of learned actuators in a step of ``go2-flat``, and their torques beside those of torch.

    python -m benchmarks.actuator_nets [--worlds 4096] [--ways network ...] [--device cuda:0] [--json FILE]

``servos``: the task as it is. ``network``: three layers of 32 units for twelve joints, errors and rates now and two and
four substeps ago. The other rows are other ways to compute the same torques, see WAYS. All are graphs of a whole step,
replayed in turns. The bound is that of float32 products and sums: 2 x 2272 operations a joint and substep at 132
multiprocessors x 128 x 2 x 1.98 GHz.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import statistics
import sys
from typing import Any
from unittest import mock

import numpy as np
import torch

from warp_spo.env import Env, actions, learning
from warp_spo.env.actuator_nets import ActuatorNetwork
from warp_spo.env.compile import actuator_launches
from warp_spo.env.tasks import go2_flat
from warp_spo.execution import plan
from warp_spo.kernels import tensor_networks

from . import command_line, env_times

TURNS = 7
PEAK = 132 * 128 * 2 * 1.98e3  # operations a microsecond
STEPS = 100
ALIKE = 20  # steps whose bits are compared
WAYS: dict[str, dict[str, Any]] = {
    "network": {},
    "kernels apart": {"JOINED_ON": ()},
    "products in float32": {"TENSOR_CORES": False},
    "layers in a loop": {"LAYERS_IN_A_LOOP": True},
    "a tile at a time": {"TILES": 1},
    "without helpers": {"MOST_TEAM": 0},
    "a reciprocal each": {"PAIRS": False},
}
"""Constants of MODULES, by the name of a row."""
MODULES = actuator_launches, plan, tensor_networks
MOST = 1.2  # times the step with servos
SAME = 1e-6  # of the largest torque


def network(sizes: tuple[int, ...], lags: tuple[int, ...]) -> ActuatorNetwork:
    """Return a network with random weights, as torch draws those of its layers."""
    rng = np.random.default_rng(0)
    weights = [rng.uniform(-1, 1, size=(o, i)) / np.sqrt(i) for i, o in itertools.pairwise(sizes)]
    biases = [rng.uniform(-1, 1, size=o) / np.sqrt(i) for i, o in itertools.pairwise(sizes)]
    return ActuatorNetwork(weights, biases, "softsign", input_idx=lags, vel_scale=0.1, torque_scale=20.0)


def build(worlds: int, device: Any, net: ActuatorNetwork | None, **options: Any) -> Env:
    """Return the task, its servos replaced by a network."""

    def make(scene: Any, worlds: int, device: Any, options: Any, **own: Any) -> Env:
        acts = own.pop("actions") if net is None else actions.ActuatorNet(net, scale=0.25)
        own.pop("actions", None)
        return Env(scene, worlds, device, actions=acts, **own, **options)

    held, go2_flat.make_env = go2_flat.make_env, make
    try:
        return go2_flat.build(worlds, device, **options)
    finally:
        go2_flat.make_env = held


def build_way(worlds: int, device: Any, net: ActuatorNetwork, changes: dict[str, Any], **options: Any) -> Env:
    """Return the task with a network and other constants."""
    with contextlib.ExitStack() as held:
        for name, value in changes.items():
            module = next(each for each in MODULES if hasattr(each, name))
            held.enter_context(mock.patch.object(module, name, value))
        return build(worlds, device, net, **options)


def bits(env: Env, worlds: int = 64) -> torch.Tensor:
    """Return the states of the first ``worlds`` after ALIKE steps."""
    generator = torch.Generator().manual_seed(2)
    for _ in range(ALIKE):
        given = torch.randn(worlds, 12, generator=generator)
        env.step(torch.cat([given, torch.zeros(env.num_envs - worlds, 12)]).to(env.device))
    return torch.cat([env.q, env.qd], dim=1)[:worlds].clone()


def compare(device: Any, net: ActuatorNetwork, changes: dict[str, Any], worlds: int = 64) -> float:
    """Return the largest error of torques through STEPS steps, as a share of the largest torque.

    Kernels apart compute them, so that states before substeps can be read; :func:`main` compares its bits with others.
    """
    env = build_way(worlds, device, net, changes | {"JOINED_ON": ()}, graph=False)
    recorded: list[list[torch.Tensor]] = []
    step = env._step_dynamics

    def record(controls: dict[str, torch.Tensor]) -> None:
        recorded.append([each.clone() for each in (env.q, env.qd, controls["tau"])])
        step(controls)

    env._step_dynamics = record  # type: ignore[method-assign]
    limit = torch.tensor(env.scene.values["joint_effort_limit"][0, 6:], device=env.device)
    generator, past, worst, largest = torch.Generator().manual_seed(0), [], 0.0, 0.0
    zero = torch.zeros(worlds, 12, device=env.device)
    for _ in range(STEPS):
        recorded.clear()
        done = env.step(torch.randn(worlds, 12, generator=generator).to(env.device))[2].bool()
        target = env._tensors["net_targets"][:, 7:]
        for q, qd, tau in recorded:
            past = [(target - q[:, 7:], qd[:, 6:]), *past[: max(net.input_idx)]]
            seen = [past[lag] if lag < len(past) else (zero, zero) for lag in net.input_idx]
            errors, rates = (torch.stack([each[i] for each in seen], dim=-1) for i in (0, 1))
            torque = net.torque(errors.double(), rates.double()).clamp(-limit, limit)  # float32 may be TF32 on a GPU
            worst = max(worst, float((tau[:, 6:] - torque).abs().max()))
            largest = max(largest, float(torque.abs().max()))
        past = [tuple(torch.where(done[:, None], 0.0, x) for x in each) for each in past]  # type: ignore[misc]
    return worst / largest


def show(found: dict[str, Any]) -> None:
    """Print figures."""
    for name, value in found.items():
        unit = "" if isinstance(value, str) or "over" in name or "error" in name else " us"
        print(f"{name:34} {value if isinstance(value, str) else f'{value:10.4g}'}{unit}", flush=True)


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("actuator_nets", __doc__)
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS), metavar="ROW", help="rows, in quotes")
    parser.add_argument("--compile", action="store_true", help="compile their kernels and end")
    options = parser.parse_args(arguments)
    device = learning.pick_device(options.device)
    whole = network((6, 32, 32, 32, 1), (0, 2, 4))
    ways = {name: changes for name, changes in WAYS.items() if name in ("network", *options.ways)}
    if options.compile:
        for name in options.ways:
            build_way(options.worlds, device, whole, WAYS[name])
        return 0
    found: dict[str, Any] = {
        "error of torques": compare(device, whole, {}),
        "error of torques in float32": compare(device, whole, {"TENSOR_CORES": False}),
    }
    first = bits(build_way(64, device, whole, {}))
    for name, worlds, changes in (("100 worlds", 100, {}), ("kernels apart", 64, WAYS["kernels apart"])):
        found[f"bits: {name}"] = "equal" if bits(build_way(worlds, device, whole, changes)).equal(first) else "other"
    show(found)
    made = {"servos": build(options.worlds, device, None)}
    made |= {name: build_way(options.worlds, device, whole, changes) for name, changes in ways.items()}
    for env in made.values():
        assert env_times.drive(env, env_times.DRIVEN), "observations that are not finite"
    turns = [{name: env_times.time_of(env.replay, device) for name, env in made.items()} for _ in range(TURNS)]
    found |= {name: statistics.median(turn[name] for turn in turns) for name in made}
    for name in ("servos", "network"):
        found[f"dynamics, {name}"] = env_times.time_of(env_times.as_graph(made[name]._physics, device), device)
    products = sum(w.size for w in whole.weights)
    found["bound of the kernels"] = 4 * options.worlds * 12 * 2 * products / PEAK
    found |= {f"{name} over servos": found[name] / found["servos"] for name in ways}
    found["device"] = torch.cuda.get_device_name(device) if torch.device(device).type == "cuda" else "cpu"
    show(found)
    error = found["error of torques"]
    fine = error < SAME and all(value == "equal" for name, value in found.items() if name.startswith("bits"))
    print(f"torques within {SAME:g}: {fine}; a step at most {MOST} times: {found['network over servos'] <= MOST}")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1))
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main())
