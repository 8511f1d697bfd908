"""Training of a task by rsl_rl's PPO as it is released: settings, progress, checkpoints.

On CUDA a rollout is one graph, and an update another: :class:`CapturedPPO`. Networks and storage are rsl_rl's.
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
from rsl_rl.modules.distribution import GaussianDistribution

from ..runtime.arrays import parse_device
from . import training_files
from .captured_ppo import CapturedPPO
from .environment import Env
from .loggers import check_loggers
from .runner import Runner, describe_end, load_checkpoint, run
from .startup import PRECISIONS
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
        normalize: whether observations are normalised by their mean and deviation. precision: of the networks' products
            on a GPU: "float32"; "tf32"; "bfloat16" in updates, with weights and losses in float32.

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
    precision: str = "tf32"

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
        if self.precision not in PRECISIONS:
            raise ValueError(f"Learner: precision is {self.precision!r}; expected one of {', '.join(PRECISIONS)}")

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
                "use_mixed_precision": self.precision == "bfloat16",
            },
        }  # fmt: skip


class Gaussian(GaussianDistribution):
    """Normal distribution whose samples need no check on the host, so that a graph can hold them."""

    def sample(self) -> torch.Tensor:
        """Return a random action for each row."""
        return self.mean + self.std * torch.randn_like(self.mean)


def pick_device(asked: str | None) -> str:
    """Return the device to learn on: what is asked for, or this process's GPU, or "cpu".

    On a CPU torch takes one thread: networks are small, and several threads wait for each other.
    """
    local = os.environ.get("LOCAL_RANK", "0")
    device = asked or (f"cuda:{local}" if torch.cuda.is_available() else "cpu")
    if not parse_device(device, "--device").is_cuda:
        torch.set_num_threads(1)
    else:
        torch.cuda.set_device(device)
    return device


def check_precision(precision: str, device: str) -> None:
    """Raise ValueError where a device cannot learn by a precision."""
    if precision != "bfloat16":
        return
    on_gpu = torch.device(device).type == "cuda"
    if not on_gpu or torch.cuda.get_device_capability(device) < (8, 0):
        name = torch.cuda.get_device_name(device) if on_gpu else "a CPU"
        raise ValueError(
            f"Learner: precision is 'bfloat16' on {device}, {name}; expected a GPU of compute capability 8.0 or above, "
            "or 'float32' or 'tf32'"
        )


def set_precision(precision: str) -> None:
    """Let torch multiply matrices of float32 in TF32 or not; the dynamics never do."""
    torch.set_float32_matmul_precision("highest" if precision == "float32" else "high")


def make_runner(
    env: Env, learner: Learner, folder: Path | None = None, save_interval: int = 100, every: int = 10,
    began: float | None = None, seconds: float = math.inf, loggers: Sequence[str] = (),
) -> Runner:  # fmt: skip
    """Return rsl_rl's runner on an environment, which logs the training in ``folder``; see :func:`train`."""
    for name, value in (("save_interval", save_interval), ("every", every)):
        check_whole("train", name, value, 1)
    check_positive("train", "seconds", seconds, endless=True)
    set_precision(learner.precision)
    with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints every layer of both networks
        runner = Runner(env, learner.settings(env, save_interval), str(env.device))
    began = time.time() if began is None else began
    log = TrainingLog(
        env, folder, every, began, runner.gpu_global_rank == 0, seconds, runner.end_iteration, loggers,
        learner.steps * env.num_envs * runner.gpu_world_size, dataclasses.asdict(learner),
    )  # fmt: skip
    runner.logger = log  # type: ignore[assignment]
    runner.alg.meanwhile = log.write_elsewhere  # type: ignore[attr-defined]
    return runner


def prepare(
    env: Env, learner: Learner, folder: str | Path, iterations: int | None = None, resume: str | Path | None = None,
    seed: int = 0, save_interval: int = 100, every: int = 10, began: float | None = None, seconds: float = math.inf,
    loggers: Sequence[str] | None = (),
) -> tuple[Runner, int]:  # fmt: skip
    """Return a runner that is ready to train, and how many iterations are left; see :func:`train`."""
    check_folder(folder, resume)
    check_precision(learner.precision, str(env.device))
    if iterations is not None:
        check_whole("train", "iterations", iterations, 1)
    torch.manual_seed(check_whole("train", "seed", seed, 0, 2**64 - 1))
    folder = Path(folder)
    if str(resume) == training_files.LATEST:
        resume = training_files.newest(folder)  # None: a training that begins
    runner = make_runner(env, learner, folder, save_interval, every, began, seconds, check_loggers(loggers))
    first = load_checkpoint(runner, resume) + 1 if resume is not None else 0
    runner.logger.first = first  # type: ignore[attr-defined]
    total = learner.iterations if iterations is None else iterations
    if first >= total:
        source = "no checkpoint" if resume is None else repr(str(resume))
        raise ValueError(f"train: {source} has {first} iterations, and {total} are asked for in all; expected more")
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
