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
import signal
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.modules.distribution import GaussianDistribution

from ..runtime.arrays import parse_device
from . import training_files
from .environment import Env
from .loggers import checked
from .runner import Runner, describe_end, load_checkpoint, run
from .training_log import TrainingLog
from .validation import check_folder, check_number, check_positive, check_whole

DEVIATIONS = (0.05, 2.0)  # range of the deviation of actions


@dataclasses.dataclass(frozen=True)
class Learner:
    """Settings of PPO for a task.

    Attributes:
        iterations: of collecting and learning. worlds: that a training takes if none are given.
        steps: of each world in an iteration. hidden: widths of the layers of actor and critic.
        deviation: of the first actions. discount, trace: gamma and lambda. rate: first learning rate; target: of the
            KL divergence, to which the rate adapts. epochs, batches: of each iteration. entropy: weight of its bonus.
        normalize: whether observations are normalised by their mean and deviation.

    Raises:
        ValueError: a setting is none; the message names it.
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

    def __post_init__(self) -> None:
        for name in ("iterations", "worlds", "steps", "epochs", "batches"):
            check_whole("Learner", name, getattr(self, name), 1)
        if not isinstance(self.hidden, tuple | list) or not self.hidden:
            raise ValueError(
                f"Learner: hidden is {self.hidden!r}; expected widths of one layer or more, such as (64, 64)"
            )
        for i, width in enumerate(self.hidden):
            check_whole("Learner", f"hidden[{i}]", width, 1)
        for name in ("rate", "target"):
            check_positive("Learner", name, getattr(self, name))
        for name, least, most in (("deviation", *DEVIATIONS), ("discount", 0.0, 1.0), ("trace", 0.0, 1.0)):
            check_number("Learner", name, getattr(self, name), least, most)
        check_number("Learner", "entropy", self.entropy, 0.0)
        if not isinstance(self.normalize, bool):
            raise ValueError(f"Learner: normalize is {self.normalize!r}; expected True or False")

    def settings(self, env: Env, save_interval: int) -> dict[str, Any]:
        """Return the settings in rsl_rl's words.

        Raises:
            ValueError: an iteration has too few steps of all worlds to be split into batches.
        """
        samples = self.steps * env.num_envs
        if samples < max(2, self.batches):  # the deviation of one advantage is none
            raise ValueError(
                f"Learner: {env.num_envs} world(s) take steps={self.steps} in an iteration, {samples} in all, for "
                f"batches={self.batches}; expected two steps or more, and one for each batch"
            )
        model = {"class_name": "MLPModel", "hidden_dims": list(self.hidden), "activation": "elu",
                 "obs_normalization": self.normalize}  # fmt: skip
        distribution = {"class_name": Gaussian, "init_std": self.deviation, "std_range": DEVIATIONS}
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
    _kept: tuple[torch.Tensor, ...] = ()  # what was learned before this iteration
    _kept_rate = 0.0

    def act(self, obs: Any) -> torch.Tensor:
        """Sample actions and keep what the storage needs, as PPO does."""
        if torch.device(self.device).type != "cuda" or self.actor.is_recurrent or not self.captures:
            return super().act(obs)
        if self.graph is None:
            before = torch.cuda.get_rng_state(self.device)
            super().act(obs)  # warms up, and draws nothing: a training that resumes has the same numbers
            torch.cuda.set_rng_state(before, self.device)
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
        """Learn, and keep the normalisers' deviations where the graph reads them.

        Raises:
            NotFiniteError: the policy is not finite any more; it is again what it was before, and so is the optimizer.
        """
        self._keep()
        models = [model.obs_normalizer for model in (self.actor, self.critic) if model.obs_normalization]
        places = [model._std for model in models]
        losses = super().update()
        with torch.inference_mode():
            for model, place in zip(models, places, strict=True):
                place.copy_(model._std)
                model._std = place
        if not self._is_finite():
            self._keep(back=True)
            raise NotFiniteError(self._find_term())
        return losses

    def _learned(self) -> list[torch.Tensor]:
        """Return the tensors that learning changes: networks, normalisers, the optimizer's state."""
        networks = [*self._raw_actor.state_dict().values(), *self._raw_critic.state_dict().values()]
        state = [value for each in self.optimizer.state.values() for value in each.values()]
        return networks + [value for value in state if isinstance(value, torch.Tensor)]

    @torch.no_grad()
    def _keep(self, back: bool = False) -> None:
        """Copy what learning changes; ``back``: make it what it was, the learning rate, too."""
        tensors = self._learned()
        if back:
            steps = len(self._kept) < len(tensors)  # the optimizer had taken none
            torch._foreach_copy_(tensors[: len(self._kept)], self._kept)
            self.learning_rate = self._kept_rate
            for group in self.optimizer.param_groups:
                group["lr"] = self.learning_rate
            if steps:
                self.optimizer.state.clear()
            return
        if [x.shape for x in self._kept] != [x.shape for x in tensors]:
            self._kept = tuple(torch.empty_like(x) for x in tensors)
        torch._foreach_copy_(self._kept, tensors)
        self._kept_rate = self.learning_rate

    def _is_finite(self) -> bool:
        """Return whether networks and normalisers hold finite numbers alone, the same in all processes."""
        models = (self._raw_actor, self._raw_critic)
        numbers = [x for model in models for x in model.state_dict().values() if x.is_floating_point()]
        return bool(torch.stack(torch._foreach_norm(numbers, math.inf)).isfinite().all())

    def _find_term(self) -> str:
        """Learn again from the same rollout up to the first gradient that is not finite; name the terms of its loss."""

        def look(optimizer: Any, *_: Any) -> None:
            gradients = [w.grad for group in optimizer.param_groups for w in group["params"] if w.grad is not None]
            if not bool(torch.stack(torch._foreach_norm(gradients, math.inf)).isfinite().all()):
                raise FloatingPointError

        hook = self.optimizer.register_step_pre_hook(look)
        try:
            super().update()
        except FloatingPointError as error:
            terms = loss_terms(error)
            bad = [name for name, value in terms.items() if not math.isfinite(value)]
            others = "the loss of another process" if self.is_multi_gpu else "the gradient of a finite loss"
            return f"loss {', '.join(bad)} not finite" if bad else f"{others} is not finite"
        finally:
            hook.remove()
            self._keep(back=True)
        return "observations that are not finite reached the normalisers"


class NotFiniteError(FloatingPointError):
    """Learning has made a policy that is not finite; the message names the terms of the loss."""


def loss_terms(error: BaseException) -> dict[str, float]:
    """Return the terms of the loss where an error interrupted rsl_rl's ``PPO.update``, by their names in the log."""
    frame = error.__traceback__
    while frame is not None:
        found = frame.tb_frame.f_locals
        if "surrogate_loss" in found:
            names = {"surrogate": "surrogate_loss", "value": "value_loss", "entropy": "entropy"}
            return {name: float(found[local].detach().mean()) for name, local in names.items()}
        frame = frame.tb_next
    return {}


KEPT = ("actions", "values", "actions_log_prob", "distribution_params", "hidden_states")


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
    began: float | None = None, seconds: float = math.inf, loggers: Sequence[str] = (),
) -> Runner:  # fmt: skip
    """Return rsl_rl's runner on an environment, which logs the training in ``folder``; see :func:`train`."""
    for name, value in (("save_interval", save_interval), ("every", every)):
        check_whole("train", name, value, 1)
    check_positive("train", "seconds", seconds, endless=True)
    with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints every layer of both networks
        runner = Runner(env, learner.settings(env, save_interval), str(env.device))
    began = time.time() if began is None else began
    log = TrainingLog(
        env, folder, every, began, runner.gpu_global_rank == 0, seconds, runner.end_iteration, loggers,
        learner.steps * env.num_envs * runner.gpu_world_size, dataclasses.asdict(learner),
    )  # fmt: skip
    runner.logger = log  # type: ignore[assignment]
    return runner


def prepare(
    env: Env, learner: Learner, folder: str | Path, iterations: int | None = None, resume: str | Path | None = None,
    seed: int = 0, save_interval: int = 100, every: int = 10, began: float | None = None, seconds: float = math.inf,
    loggers: Sequence[str] | None = (),
) -> tuple[Runner, int]:  # fmt: skip
    """Return a runner that is ready to train, and how many iterations are left; see :func:`train`."""
    check_folder(folder, resume)
    if iterations is not None:
        check_whole("train", "iterations", iterations, 1)
    torch.manual_seed(check_whole("train", "seed", seed, 0, 2**64 - 1))
    folder = Path(folder)
    if str(resume) == training_files.LATEST:
        resume = training_files.newest(folder)  # None: a training that begins
    runner = make_runner(env, learner, folder, save_interval, every, began, seconds, checked(loggers))
    first = load_checkpoint(runner, resume) + 1 if resume is not None else 0
    runner.logger.first = first  # type: ignore[attr-defined]
    total = learner.iterations if iterations is None else iterations
    if first >= total:
        has = "no checkpoint" if resume is None else repr(str(resume))
        raise ValueError(f"train: {has} has {first} iterations, and {total} are asked for in all; expected more")
    folder.mkdir(parents=True, exist_ok=True)
    runner.logger.init_logging_writer()
    return runner, total - first


def train(
    env: Env, learner: Learner, folder: str | Path, iterations: int | None = None, resume: str | Path | None = None,
    seed: int = 0, save_interval: int = 100, every: int = 10, began: float | None = None, seconds: float = math.inf,
    loggers: Sequence[str] | None = (),
) -> Runner:  # fmt: skip
    """Train, and leave checkpoints ``model_N.pt``, ``last.pt`` with the worlds, and ``progress.jsonl`` in a folder.

    Under torchrun each process has its own worlds, gradients and normalisers are averaged over all, and the first
    process writes; its log is of its own worlds. Ctrl-C and SIGTERM end after the iteration, with checkpoints; they
    are raised then, as KeyboardInterrupt and SystemExit. A checkpoint that cannot be written is a warning, and is tried
    again every ``every`` iterations.

    Args:
        env: the environment.
        learner: settings.
        folder: is made; a training that resumes may continue in its own, whose rows after the checkpoint are dropped.
        iterations: in all, those before ``resume`` included; None: as the settings say.
        resume: checkpoint to continue from, or "latest": the newest whole one of the folder, if it has any. From
            ``last.pt`` the training has the bits of one that was not stopped, on a CPU.
        seed: of the learner's random numbers.
        save_interval: iterations from one checkpoint to the next.
        every: iterations from one printed line to the next.
        began: time from which seconds count, as of ``time.time``.
        seconds: after which no iteration starts, in any of the processes.
        loggers: beside the rows of the folder: "tensorboard", "wandb"; None: TensorBoard where it is installed.

    Raises:
        ValueError: the folder holds another training, the checkpoint is not of this task, or nothing is left to do; or
            a number of iterations or seconds is none, or not above zero.
        OSError: there is no such checkpoint, or the folder cannot be made.
        FloatingPointError: learning made a policy that is not finite; the last one before is kept as a checkpoint.
    """
    runner, left = prepare(
        env, learner, folder, iterations, resume, seed, save_interval, every, began, seconds, loggers
    )
    ending = run(runner, left)
    if ending.fault:
        raise FloatingPointError(f"train: {describe_end(ending)}")
    if ending.unwritten:
        warnings.warn(f"train: {describe_end(ending)}", stacklevel=2)
    if ending.signal == signal.SIGINT:
        raise KeyboardInterrupt(f"train: {describe_end(ending)}")
    if ending.signal:
        raise SystemExit(ending.status)
    return runner


def leave() -> None:
    """End this process's part in a training of several."""
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


def policy_of(runner: Runner) -> Any:
    """Return the function from observations (a TensorDict) to actions that the training has found."""
    model = runner.get_inference_policy(str(runner.device))

    def policy(observations: Any) -> torch.Tensor:
        with torch.inference_mode():
            return model(observations)

    return policy
