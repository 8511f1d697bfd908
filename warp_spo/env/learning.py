"""Training of a task by rsl_rl's PPO as it is released: settings, progress, checkpoints.

On CUDA the policy's part of a rollout (actions, values, log-probabilities) is one graph, as the environment's step is.
The learner, its losses and its storage are rsl_rl's.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import os
import pickle
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.runners import OnPolicyRunner

from ..errors import as_integer
from ..runtime.arrays import parse_device
from .environment import Env
from .training_log import TimeLimitReached, TrainingLog
from .validation import check_folder


@dataclasses.dataclass(frozen=True)
class Learner:
    """Settings of PPO for a task.

    Attributes:
        iterations: of collecting and learning. worlds: that a training takes if none are given.
        steps: of each world in an iteration. hidden: widths of the layers of actor and critic.
        deviation: of the first actions. discount, trace: gamma and lambda. rate: first learning rate; target: of the
            KL divergence, to which the rate adapts. epochs, batches: of each iteration. entropy: weight of its bonus.
    """

    iterations: int = 300
    worlds: int = 4096
    steps: int = 24
    hidden: tuple[int, ...] = (512, 256, 128)
    deviation: float = 1.0
    discount: float = 0.99
    trace: float = 0.95
    rate: float = 1e-3
    target: float = 0.01
    epochs: int = 5
    batches: int = 4
    entropy: float = 0.01
    normalize: bool = True

    def settings(self, env: Env, save_interval: int) -> dict[str, Any]:
        """Return the settings in rsl_rl's words."""
        model = {"class_name": "MLPModel", "hidden_dims": list(self.hidden), "activation": "elu",
                 "obs_normalization": self.normalize}  # fmt: skip
        distribution = {"class_name": Gaussian, "init_std": self.deviation, "std_range": (0.05, 2.0)}
        return {
            "num_steps_per_env": self.steps,
            "save_interval": save_interval,
            # The environment's guard lets no such number out, counts its term and goes on. rsl_rl's check knows NaN
            # alone, ends the training for one world, and waits for the device three times a step.
            "check_for_nan": False,
            "obs_groups": {"actor": ["actor"], "critic": ["critic" if "critic" in env.num_obs else "actor"]},
            "actor": model | {"distribution_cfg": distribution},
            "critic": dict(model),
            "algorithm": {
                "class_name": CapturedPPO, "num_learning_epochs": self.epochs, "num_mini_batches": self.batches,
                "clip_param": 0.2, "gamma": self.discount, "lam": self.trace, "value_loss_coef": 1.0,
                "entropy_coef": self.entropy, "learning_rate": self.rate, "max_grad_norm": 1.0, "schedule": "adaptive",
                "desired_kl": self.target, "use_clipped_value_loss": True,
            },
        }  # fmt: skip


class Gaussian(GaussianDistribution):
    """Normal distribution whose samples need no check on the host, so that a graph can hold them."""

    def sample(self) -> torch.Tensor:
        """Return a random action for each row."""
        return self.mean + self.std * torch.randn_like(self.mean)


class CapturedPPO(PPO):
    """rsl_rl's PPO, whose ``act`` is one CUDA graph after the first call; on a CPU it is PPO.

    Models that cannot be captured act without a graph, and a warning says so.
    """

    graph: Any = None
    captures = True

    def act(self, obs: Any) -> torch.Tensor:
        """Sample actions and keep what the storage needs, as PPO does."""
        if torch.device(self.device).type != "cuda" or self.actor.is_recurrent or not self.captures:
            return super().act(obs)
        if self.graph is None:
            super().act(obs)  # warms up
            self.seen, graph = obs.clone(), torch.cuda.CUDAGraph()
            try:
                with torch.cuda.graph(graph, capture_error_mode="thread_local"):  # NCCL has threads of its own
                    super().act(self.seen)
            except RuntimeError as error:
                warnings.warn(f"train: the policy acts without a CUDA graph: {error}", stacklevel=2)
                self.captures = False
                return super().act(obs)
            self.graph = graph
            self.acted = {name: getattr(self.transition, name) for name in KEPT}
        for name, value in self.seen.items():
            value.copy_(obs[name])
        self.graph.replay()
        for name, value in self.acted.items():
            setattr(self.transition, name, value)
        self.transition.observations = obs
        return self.transition.actions  # type: ignore[return-value]

    def update(self) -> dict[str, float]:
        """Learn, and keep the normalisers' deviations where the graph reads them."""
        models = [model.obs_normalizer for model in (self.actor, self.critic) if model.obs_normalization]
        places = [model._std for model in models]
        losses = super().update()
        with torch.inference_mode():
            for model, place in zip(models, places, strict=True):
                place.copy_(model._std)
                model._std = place
        return losses


KEPT = ("actions", "values", "actions_log_prob", "distribution_params", "hidden_states")


class Runner(OnPolicyRunner):
    """rsl_rl's runner, whose checkpoints hold the levels of curricula.

    Processes without GPUs average gradients through gloo, where rsl_rl knows NCCL alone.
    """

    def save(self, path: str, infos: dict | None = None) -> None:
        """Save networks, the optimizer's state, and how far this process's worlds have come in curricula."""
        reached = {name: tensor.cpu().clone() for name, tensor in self.env.levels().items()}
        super().save(path, (infos or {}) | {"levels": reached})

    def _configure_multi_gpu(self) -> None:
        size = int(os.environ.get("WORLD_SIZE", "1"))
        if self.device != "cpu" or size == 1:
            return super()._configure_multi_gpu()
        self.gpu_world_size, self.is_distributed = size, True
        self.gpu_global_rank, self.gpu_local_rank = (int(os.environ[name]) for name in ("RANK", "LOCAL_RANK"))
        ranks = {"global_rank": self.gpu_global_rank, "local_rank": self.gpu_local_rank}
        self.cfg["multi_gpu"] = ranks | {"world_size": size}
        torch.distributed.init_process_group("gloo", rank=self.gpu_global_rank, world_size=size)


def pick_device(asked: str | None) -> str:
    """Return the device to learn on: what is asked for, or this process's GPU, or "cpu".

    On a CPU torch takes one thread: networks are small, and several threads wait for each other. On a GPU networks
    multiply matrices in TF32; the dynamics do not.
    """
    local = os.environ.get("LOCAL_RANK", "0")
    device = asked or (f"cuda:{local}" if torch.cuda.is_available() else "cpu")
    if not parse_device(device, "--device").is_cuda:
        torch.set_num_threads(1)
    else:
        torch.cuda.set_device(device)
        torch.set_float32_matmul_precision("high")
    return device


def make_runner(
    env: Env, learner: Learner, folder: Path | None = None, save_interval: int = 100, every: int = 10,
    began: float | None = None, seconds: float = math.inf,
) -> OnPolicyRunner:  # fmt: skip
    """Return rsl_rl's runner on an environment, which logs the training in ``folder``."""
    with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints every layer of both networks
        runner = Runner(env, learner.settings(env, save_interval), None, device=str(env.device))
    began = time.time() if began is None else began
    runner.logger = TrainingLog(env, folder, every, began, runner.gpu_global_rank == 0, seconds)  # type: ignore[assignment]
    return runner


def load_checkpoint(runner: OnPolicyRunner, file: str | Path, learns: bool = True) -> int:
    """Load a checkpoint, tensors and numbers only, and return its iteration.

    Args:
        runner: what takes it. file: of a training of the same task. learns: whether it takes the optimizer's state.

    Raises:
        OSError: there is no such file. ValueError: it is no checkpoint, or that of networks with other sizes.
    """
    try:
        found = torch.load(file, weights_only=True, map_location=runner.device)
        missing = {"actor_state_dict", "critic_state_dict", "optimizer_state_dict", "iter"} - set(found)
    except (pickle.UnpicklingError, EOFError, KeyError, RuntimeError, TypeError) as error:
        raise ValueError(
            f"checkpoint {str(file)!r}: cannot be read ({type(error).__name__}); expected a model_N.pt of a training"
        ) from None
    if missing:
        raise ValueError(
            f"checkpoint {str(file)!r}: has no {', '.join(sorted(missing))}; expected a model_N.pt of a training"
        )
    parts = {"actor": True, "critic": True, "optimizer": learns, "iteration": True, "rnd": False}
    iteration, levels = found["iter"], (found.get("infos") or {}).get("levels", {})
    if as_integer(iteration) is None or not isinstance(levels, Mapping):
        raise ValueError(
            f"checkpoint {str(file)!r}: iter is {iteration!r}, its levels are {type(levels).__name__}; expected an "
            "integer, and a dictionary: a model_N.pt of a training"
        )
    try:
        runner.alg.load(found, parts, strict=True)
    except RuntimeError as error:
        first = next((line.strip() for line in str(error).splitlines()[1:]), str(error))
        raise ValueError(
            f"checkpoint {str(file)!r}: does not fit the task's networks ({first}); expected one of the same task"
        ) from None
    if learns:
        runner.current_learning_iteration = iteration + 1
        resume_levels(runner.env, file, levels)
    return int(iteration)


def resume_levels(env: Env, file: str | Path, levels: Mapping[str, torch.Tensor]) -> None:
    """Start worlds at a checkpoint's levels of curricula; warn where it has none and the environment has."""
    if levels.keys() != env.levels().keys():
        warnings.warn(
            f"checkpoint {str(file)!r}: has levels of {', '.join(levels) or 'nothing'}, the task's curricula are "
            f"{', '.join(env.levels()) or 'none'}; worlds begin at the first levels",
            stacklevel=3,
        )
    elif levels:
        env.start_at(levels)


def prepare(
    env: Env, learner: Learner, folder: str | Path, iterations: int | None = None, resume: str | Path | None = None,
    seed: int = 0, save_interval: int = 100, every: int = 10, began: float | None = None, seconds: float = math.inf,
) -> tuple[OnPolicyRunner, int]:  # fmt: skip
    """Return a runner that is ready to train, and how many iterations are left; see :func:`train`."""
    check_folder(folder, resume)
    torch.manual_seed(seed)
    folder = Path(folder)
    runner = make_runner(env, learner, folder, save_interval, every, began, seconds)
    first = load_checkpoint(runner, resume) + 1 if resume is not None else 0
    runner.logger.first = first  # type: ignore[attr-defined]
    total = learner.iterations if iterations is None else iterations
    if runner.is_distributed and seconds < math.inf:
        raise ValueError(
            f"train: seconds {seconds} and several processes; expected iterations alone, for all to stop at"
        )
    if first >= total:
        has = "no checkpoint" if resume is None else repr(str(resume))
        raise ValueError(f"train: {has} has {first} iterations, and {total} are asked for in all; expected more")
    folder.mkdir(parents=True, exist_ok=True)
    return runner, total - first


def run(runner: OnPolicyRunner, iterations: int) -> None:
    """Train so many iterations, or until the time is over; then leave a checkpoint."""
    try:
        runner.learn(iterations, init_at_random_ep_len=True)
    except TimeLimitReached:
        runner.save(str(Path(runner.logger.log_dir) / f"model_{runner.current_learning_iteration}.pt"))


def train(
    env: Env, learner: Learner, folder: str | Path, iterations: int | None = None, resume: str | Path | None = None,
    seed: int = 0, save_interval: int = 100, every: int = 10, began: float | None = None, seconds: float = math.inf,
) -> OnPolicyRunner:  # fmt: skip
    """Train, and leave checkpoints ``model_N.pt`` and ``progress.jsonl`` in a folder.

    Under torchrun each process has its own worlds, gradients and normalisers are averaged over all, and the first
    process writes; its log is of its own worlds.

    Args:
        env: the environment.
        learner: settings.
        folder: is made; a training that resumes may continue in its own, whose rows after the checkpoint are dropped.
        iterations: in all, those before ``resume`` included; None: as the settings say.
        resume: checkpoint to continue from.
        seed: of the learner's random numbers.
        save_interval: iterations from one checkpoint to the next.
        every: iterations from one printed line to the next.
        began: time from which seconds count, as of ``time.time``.
        seconds: after which no iteration starts; for one process.

    Raises:
        ValueError: the folder holds another training, the checkpoint is not of this task, or nothing is left to do.
        OSError: there is no such checkpoint, or the folder cannot be made.
    """
    runner, left = prepare(env, learner, folder, iterations, resume, seed, save_interval, every, began, seconds)
    run(runner, left)
    return runner


def leave() -> None:
    """End this process's part in a training of several."""
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


def policy_of(runner: OnPolicyRunner) -> Any:
    """Return the function from observations (a TensorDict) to actions that the training has found."""
    model = runner.get_inference_policy(str(runner.device))

    def policy(observations: Any) -> torch.Tensor:
        with torch.inference_mode():
            return model(observations)

    return policy
