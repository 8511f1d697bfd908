"""rsl_rl's runner, whose trainings can be stopped after any iteration and go on as if they had not been."""

from __future__ import annotations

import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rsl_rl.runners import OnPolicyRunner

from . import training_files
from .environment import Env
from .interruption import NAMES, StopRequest
from .launcher import is_orphan
from .training_files import LAST

STRIDE = 0xD1342543DE82EF95  # odd: seeds of trainings that resume at different iterations differ


class TrainingStopped(Exception):
    """A signal came, or the time that a training may take is over."""


class Instant:
    """A moment of the work on a device; a difference of two are seconds."""

    def __init__(self, device: Any):
        self.event = torch.cuda.Event(enable_timing=True) if torch.device(device).type == "cuda" else None
        self.seconds = time.perf_counter()
        if self.event is not None:
            self.event.record()

    def __sub__(self, before: Instant) -> float:
        if self.event is None or before.event is None:
            return self.seconds - before.seconds
        self.event.synchronize()
        return 1e-3 * before.event.elapsed_time(self.event)


class Ending(NamedTuple):
    """How a training ended.

    Attributes:
        iteration: the last that was finished. signal: that asked for the end, or 0.
        fault: why the policy would not be finite any more, or "".
        unwritten: files that could not be written, each with the reason.
    """

    iteration: int
    signal: int = 0
    fault: str = ""
    unwritten: tuple[str, ...] = ()

    @property
    def status(self) -> int:
        """The exit status: 1 for a fault or a file that is missing, 128 and the signal's number, or 0."""
        return 1 if self.fault or self.unwritten else 128 + self.signal if self.signal else 0


class Runner(OnPolicyRunner):
    """rsl_rl's runner, whose checkpoints hold the levels of curricula, and ``last.pt`` the worlds.

    Processes without GPUs average gradients through gloo, where rsl_rl knows NCCL alone.

    Attributes:
        resumed: whether it goes on with the worlds of its checkpoint. stop: the request to end.
        finished: the last whole iteration. unwritten: by name of a file why it could not be written.
    """

    current_learning_iteration: int
    resumed, finished = False, -1

    def __init__(self, env: Env, settings: dict[str, Any], device: str):
        super().__init__(env, settings, None, device=device)
        self.stop, self.unwritten = StopRequest(), dict[str, str]()
        writes = getattr(env, "write_failures", None)  # of worlds that a rollout in one graph has found
        self.watchers: list[Callable[[], None]] = [writes] if writes else []  # called at the end of each iteration

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Learn for so many iterations, as rsl_rl does, with rollouts that may be one launch."""
        alg: Any = self.alg
        if getattr(alg, "obstacle", "other algorithm"):
            return super().learn(num_learning_iterations, init_at_random_ep_len)
        if init_at_random_ep_len:
            lengths = self.env.episode_length_buf
            self.env.episode_length_buf = torch.randint_like(lengths, high=int(self.env.max_episode_length))
        obs = self.env.get_observations().to(self.device)
        alg.train_mode()
        if self.is_distributed:
            alg.broadcast_parameters()
        self.logger.init_logging_writer()
        first = self.current_learning_iteration
        for iteration in range(first, first + num_learning_iterations):
            began = Instant(self.device)
            obs = alg.collect(self.env, obs)
            collected = Instant(self.device)
            losses = alg.update()
            learned = Instant(self.device)
            self.current_learning_iteration = iteration
            self.logger.log(
                it=iteration, start_it=first, total_it=first + num_learning_iterations,
                collect_time=collected - began, learn_time=learned - collected, loss_dict=losses,
                learning_rate=alg.learning_rate, action_std=alg.deviation, rnd_weight=None, env_log=alg.log,
            )  # fmt: skip

    def save(self, path: str, infos: dict | None = None) -> None:
        """Save networks, the optimizer's state, and how far this process's worlds have come in curricula."""
        training_files.write(Path(path), self._networks({"levels": _on_host(self.env.levels())}, infos))

    def end_iteration(self, iteration: int, total: int) -> None:
        """Write what is due after an iteration, and raise TrainingStopped where it is asked for.

        All processes of a training come here, and decide alike.
        """
        self.finished = iteration
        for watch in self.watchers:
            watch()
        log: Any = self.logger
        again = bool(self.unwritten) and iteration % log.every == 0
        asked = self.stop.signal or (signal.SIGTERM if is_orphan() else 0)
        asked, late, again = self._largest(asked, time.time() > log.ends, again)
        if asked:  # a signal that came while the processes agreed counts after the next iteration
            self.stop.signal = asked
        ends = bool(asked or late)
        if ends or again or iteration + 1 == total or iteration % self.cfg["save_interval"] == 0:
            self.save_all(iteration)
        if ends and iteration + 1 < total:
            raise TrainingStopped

    def save_all(self, iteration: int, worlds: bool = True) -> None:
        """Write ``model_N.pt``, and ``last.pt`` with the worlds; a file that cannot be written is a warning.

        The first process writes for all of them.
        """
        if self.logger.log_dir is None:
            return
        own = {"levels": _on_host(self.env.levels())}
        if worlds:
            own |= {"env": _on_host(self.env.state_dict()), "random": self._random_numbers()}
        parts = self._gather(own)
        if not parts:
            return
        levels = {name: torch.cat([part["levels"][name] for part in parts]) for name in own["levels"]}
        contents = self._networks({"levels": levels}) | {"iter": iteration}
        self.logger.flush()  # type: ignore[attr-defined]
        before, self.unwritten = self.unwritten, {}
        self._write(f"model_{iteration}.pt", contents, before)
        if worlds:
            self._write(LAST, contents | {"worlds": parts}, before)
        if before and not self.unwritten:
            print(f"train: model_{iteration}.pt is written; the disk takes files again", file=sys.stderr, flush=True)

    # -- inside ----------------------------------------------------------------------------------------------------
    def _networks(self, found: dict[str, Any], infos: dict | None = None) -> dict[str, Any]:
        return self.alg.save() | {
            "iter": self.current_learning_iteration, "infos": (infos or {}) | found,
            "format": training_files.FORMAT, "versions": training_files.versions(),
        }  # fmt: skip

    def _write(self, name: str, contents: Mapping[str, Any], before: Mapping[str, str]) -> None:
        file = Path(self.logger.log_dir) / name  # type: ignore[arg-type]
        try:
            training_files.write(file, contents)
        except OSError as error:
            self.unwritten[name] = error.strerror or str(error)
            if not before:
                warnings.warn(
                    f"train: {str(file)!r} could not be written ({self.unwritten[name]}); the training goes on and "
                    f"tries again every {self.logger.every} iterations",  # type: ignore[attr-defined]
                    stacklevel=4,
                )

    def _random_numbers(self) -> dict[str, torch.Tensor]:
        """Return the states of the generators that the learner draws from."""
        found = {"cpu": torch.get_rng_state()}
        if torch.device(self.device).type == "cuda":
            found["cuda"] = torch.cuda.get_rng_state(self.device)
        return found

    def _largest(self, *flags: int | bool) -> list[int]:
        """Return the largest of each flag over all processes."""
        if not self.is_distributed:
            return list(map(int, flags))
        found = torch.tensor(list(map(int, flags)), device=self.device)
        torch.distributed.all_reduce(found, torch.distributed.ReduceOp.MAX)
        return found.tolist()

    def _gather(self, own: Any) -> list[Any]:
        """Return what all processes have, in the first one; nothing in others."""
        if not self.is_distributed:
            return [own]
        found: list[Any] = [None] * self.gpu_world_size if self.gpu_global_rank == 0 else []
        torch.distributed.gather_object(own, found or None)
        return found

    def _configure_multi_gpu(self) -> None:
        size = int(os.environ.get("WORLD_SIZE", "1"))
        if size == 1:
            return super()._configure_multi_gpu()
        self.gpu_world_size, self.is_distributed = size, True
        self.gpu_global_rank, self.gpu_local_rank = (int(os.environ[name]) for name in ("RANK", "LOCAL_RANK"))
        ranks = {"global_rank": self.gpu_global_rank, "local_rank": self.gpu_local_rank}
        self.cfg["multi_gpu"] = ranks | {"world_size": size}
        device = torch.device(self.device)
        if device.type == "cuda":
            torch.cuda.set_device(device)
        # torchrun's store outlives a restart, and with it the addresses of processes that have ended (torch 2.13)
        store = next(torch.distributed.rendezvous("env://", self.gpu_global_rank, size))[0]
        store = torch.distributed.PrefixStore(f"start {os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}", store)
        torch.distributed.init_process_group(
            "nccl" if device.type == "cuda" else "gloo", store=store, rank=self.gpu_global_rank, world_size=size
        )


def load_checkpoint(runner: OnPolicyRunner, file: str | Path, learns: bool = True) -> int:
    """Load a checkpoint, tensors and numbers only, and return its iteration.

    Where it holds the worlds (``last.pt``) and they fit, the training goes on as if it had not been stopped. Otherwise
    worlds start anew at the checkpoint's levels of curricula, and all random numbers are others than before.

    Args:
        runner: what takes it. file: of a training of the same task. learns: whether it takes the optimizer's state.

    Raises:
        OSError: there is no such file. ValueError: it is no checkpoint, or that of networks with other sizes.
    """
    found = training_files.read(file, runner.device)
    parts = {"actor": True, "critic": True, "optimizer": learns, "iteration": True, "rnd": False}
    try:
        runner.alg.load(found, parts, strict=True)
    except (RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:
        first = next((line.strip() for line in str(error).splitlines()[1:]), str(error))
        raise ValueError(
            f"checkpoint {str(file)!r}: does not fit the task's networks ({first}); expected one of the same task"
        ) from None
    iteration = int(found["iter"])
    if learns:
        runner.current_learning_iteration = iteration + 1
        runner.finished = iteration  # type: ignore[attr-defined]
        if not resume_worlds(runner, file, found.get("worlds")):
            torch.manual_seed((torch.initial_seed() + STRIDE * (iteration + 1)) % 2**64)
            runner.env.reset(seed=(runner.env.seed + STRIDE * (iteration + 1)) % 2**64)  # type: ignore[attr-defined, call-arg]
            resume_levels(runner.env, file, (found.get("infos") or {}).get("levels", {}))
    return iteration


def resume_worlds(runner: Any, file: str | Path, worlds: Any) -> bool:
    """Go on with a checkpoint's worlds and generators; return whether it has any that fit."""
    if worlds is None:
        return False
    try:
        if len(worlds) != runner.gpu_world_size:
            raise ValueError(f"has the worlds of {len(worlds)} process(es); there are {runner.gpu_world_size}")
        own = worlds[runner.gpu_global_rank]
        runner.env.load_state_dict(own["env"])
        torch.set_rng_state(own["random"]["cpu"].cpu())
        if "cuda" in own["random"] and torch.device(runner.device).type == "cuda":
            torch.cuda.set_rng_state(own["random"]["cuda"].cpu(), runner.device)
    except (ValueError, TypeError, KeyError, RuntimeError) as error:
        warnings.warn(f"checkpoint {str(file)!r}: its worlds are left ({error}); others start anew", stacklevel=4)
        return False
    runner.resumed = True
    return True


def resume_levels(env: Env, file: str | Path, levels: Mapping[str, torch.Tensor]) -> None:
    """Start worlds at a checkpoint's levels of curricula; warn where it has none and the environment has."""
    if levels.keys() != env.levels().keys():
        warnings.warn(
            f"checkpoint {str(file)!r}: has levels of {', '.join(levels) or 'nothing'}, the task's curricula are "
            f"{', '.join(env.levels()) or 'none'}; worlds begin at the first levels",
            stacklevel=4,
        )
    elif levels:
        env.start_at(levels)


def run(runner: Runner, iterations: int) -> Ending:
    """Train so many iterations, or until the time is over or a signal comes, and return how it ended.

    Checkpoints are left at the end. Ctrl-C and SIGTERM end after the iteration, a second Ctrl-C at once.
    """
    fault = ""
    with runner.stop:
        try:
            runner.learn(iterations, init_at_random_ep_len=not runner.resumed)
        except TrainingStopped:
            pass
        except FloatingPointError as error:
            fault = f"iteration {runner.finished + 1}: {error}"
            if runner.finished >= 0:
                runner.save_all(runner.finished, worlds=False)  # whose course would end in the same way
    log: Any = runner.logger
    log.flush()
    log.close()
    unwritten = runner.unwritten | log.unwritten | log.lost
    lost = tuple(f"{name} ({why})" for name, why in unwritten.items())
    return Ending(runner.finished, runner.stop.signal, fault, lost)


def describe_end(ending: Ending) -> str:
    """Return how a training ended, in words: "" where all went well."""
    words = [f"stopped after iteration {ending.iteration}: {NAMES[ending.signal]}"] if ending.signal else []
    words += [f"stopped by {ending.fault}"] if ending.fault else []
    words += [f"not written: {', '.join(ending.unwritten)}"] if ending.unwritten else []
    return "; ".join(words)


def _on_host(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor.cpu().clone() for name, tensor in tensors.items()}
