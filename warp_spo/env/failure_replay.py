"""Files of worlds that failed: what they hold, in words, and how one world takes its last steps again."""

from __future__ import annotations

import dataclasses
import io
import pickle
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..errors import shown
from ..execution.status_words import words_of_states
from ..scene.scene import Scene
from ..status import Status
from .failures import ACTIONS, FORCE, FORMAT, JUDGED, STATUS, USER, plan_of, scene_of_rows, state_arrays

if TYPE_CHECKING:
    from .environment import Env

KEYS = {
    "cause", "world", "worlds", "seed", "step", "arrays", "scene", "memory", "labels", "dt", "decimation", "device",
    "plan",
}  # fmt: skip
LEFT_OUT = ("found", "tick", "episode_length", STATUS, FORCE)  # where no number of the user's goes wrong


@dataclasses.dataclass(frozen=True)
class Failure:
    """The last steps of a world that failed, as a file of ``Env(keep_failures=...)`` holds them.

    Attributes:
        cause: why it failed: what the guard counts, such as "not finite/state/speeds", or a word such as "status
            CONTACT". world: number of the world in the whole run. worlds: that the environment had. seed: of random
            numbers. first_step, step: numbers of the first step in the file, and of the one in which the world failed,
            since the environment was made or reset with a seed.
        q, qd: before each step [step, coordinate] and [step, dof]; a step begins a new episode at its end.
        actions: [step, action]. status: of each step, numbers of ``Status`` [step].
        contact_f: forces of contacts in the step before each of the steps [step, contact, 3] [N], None where no term
            of the environment reads them.
        lengths: steps since the start of the episode, before each step [step].
        dt, decimation: of the environment. device: that it ran on. plan: granularity and length of blocks of the
            dynamics, and whether worlds were few.
        arrays: all that decides how the world goes on, before each step, by name [step, ...].
        memory: (start, size) in ``arrays["memory"]`` of what worlds remember, by name. labels: of entries of actions,
            q and qd.
    """

    cause: str
    world: int
    worlds: int
    seed: int
    step: int
    dt: float
    decimation: int
    device: str
    plan: list[Any]
    arrays: Mapping[str, torch.Tensor]
    memory: Mapping[str, tuple[int, int]]
    labels: Mapping[str, list[str]]
    pickled_scene: torch.Tensor | str

    @property
    def steps(self) -> int:
        """How many steps there are."""
        return len(self.arrays["q"])

    @property
    def first_step(self) -> int:
        """The number of the first step."""
        return self.step + 1 - self.steps

    @property
    def q(self) -> np.ndarray:
        return self.arrays["q"].numpy()

    @property
    def qd(self) -> np.ndarray:
        return self.arrays["qd"].numpy()

    @property
    def actions(self) -> np.ndarray:
        return self.arrays[ACTIONS].numpy()

    @property
    def status(self) -> np.ndarray:
        return self.arrays[STATUS].numpy()

    @property
    def contact_f(self) -> np.ndarray | None:
        return self.arrays[FORCE].numpy() if FORCE in self.arrays else None

    @property
    def lengths(self) -> np.ndarray:
        return self.arrays["episode_length"].numpy()

    def scene(self) -> Scene:
        """Return the scene, with the values that this world had before the last step.

        It is unpickled, which runs what the file says: only of files that you trust.

        Raises:
            ValueError: the scene could not be pickled when the file was written.
        """
        if isinstance(self.pickled_scene, str):
            raise ValueError(
                f"Failure.scene: the file holds no scene ({self.pickled_scene}); expected an environment whose custom "
                "hinges use functions at the top level of a module; its states are there, and Env.replay_failure works"
            )
        found = pickle.loads(self.pickled_scene.numpy().tobytes())
        own = {name.removeprefix("value_"): x for name, x in self.arrays.items() if name.startswith("value_")}
        try:
            return found.with_values(**{name: x[-1].double().numpy() for name, x in own.items()})
        except ValueError:  # what made it fail, perhaps
            return found

    def find_first(self) -> tuple[int, str, float] | None:
        """Return the step, the name and the value of the first number that is not finite; None where all are finite.

        Actions are those of the step, everything else is what it was before the step. Of a step the causes that come
        first are looked at first: actions, the state, the scene's values, what the world remembers, terms in torch.
        """
        for i in range(self.steps):
            for name, values in self._iterate_values(i):
                wrong = ~(np.abs(values) <= 1e30)
                if wrong.any():
                    entry = int(np.flatnonzero(wrong)[0])
                    labels = self.labels.get(name, ())
                    label = repr(shown(labels[entry])) if entry < len(labels) else str(entry)
                    return self.first_step + i, f"{name}[{label}]", float(values[entry])
        return None

    def describe(self) -> str:
        """Return in words what failed, when, the first number that went wrong, and what the file holds."""
        last, seconds = Status(int(self.status[-1])), self.dt * self.decimation
        lines = [
            f"world {self.world} failed in step {self.step}: {shown(self.cause, 200)}",
            f"status     {last.name}{'' if last == Status.OK else f': {last.advice}'}",
            f"episode    step {int(self.lengths[-1])}, {self.lengths[-1] * seconds:.3g} s after its start",
        ]
        found = self.find_first()
        if found:
            when = "given to" if found[1].startswith(ACTIONS) else "before"
            lines.append(f"first      {found[1]} is {found[2]:g}, {when} step {found[0]}")
        else:
            lines.append("first      all numbers are finite up to that step; env.replay_failure shows the step itself")
        if "command" in self.memory:
            start, size = self.memory["command"]
            row = self.arrays["memory"][-1, start : start + size].tolist()
            lines.append(f"command    {', '.join(f'{x:.3g}' for x in row)}")
        lines.append(
            f"file       {self.steps} steps of {seconds:g} s, {self.first_step} to {self.step}, of one of "
            f"{self.worlds} worlds on {self.device}, seed {self.seed}"
        )
        return "\n".join(lines)

    def _iterate_values(self, i: int) -> Iterator[tuple[str, np.ndarray]]:
        """Yield names and numbers of what was there before step i of the file, and its actions, first what counts."""
        arrays = {name: x[i].double().numpy().ravel() for name, x in self.arrays.items() if name not in LEFT_OUT}
        values = [name for name in arrays if name.startswith("value_")]
        for name in (ACTIONS, "q", "qd", *values):
            yield name.removeprefix("value_"), arrays[name]
        for name, (start, size) in self.memory.items():
            yield name, arrays["memory"][start : start + size]
        for name in (USER, JUDGED):
            if name in arrays:
                yield "terms in torch", arrays[name]


def read(file: str | Path) -> Failure:
    """Return what a file of ``Env(keep_failures=...)`` holds; nothing of it is executed.

    Raises:
        OSError: there is no such file. ValueError: it is none of a failure, or of another format.
    """
    name = f"failure {str(file)!r}"
    data = Path(file).read_bytes()
    try:
        found = torch.load(io.BytesIO(data), weights_only=True, map_location="cpu")
    except Exception as error:  # whatever a foreign file makes torch raise
        raise ValueError(
            f"{name}: cannot be read ({type(error).__name__}); expected a file that Env(keep_failures=...) has written"
        ) from None
    if not isinstance(found, dict) or not KEYS <= found.keys():
        raise ValueError(f"{name}: holds something else; expected a file that Env(keep_failures=...) has written")
    if found.get("format") != FORMAT:
        raise ValueError(
            f"{name}: is of format {found.get('format')!r}, this warp_spo reads format {FORMAT}; expected a file of "
            "this version"
        )
    own = {key: found[key] for key in KEYS - {"scene", "memory"}}
    memory = {key: (int(start), int(size)) for key, (start, size) in found["memory"].items()}
    return Failure(**own, memory=memory, pickled_scene=found["scene"])


@dataclasses.dataclass(frozen=True)
class ReplayedFailure:
    """The last steps of a world that failed, taken again by that world alone.

    Attributes:
        q, qd: before the first step, and after each step [step + 1, ...]; after the last one as the dynamics left them,
            before the world started anew.
        contact_f: forces of contacts in each step [step, contact, 3] [N], None in a scene without contacts.
        status: of each step [step]. reward: [step]. done: whether the episode ended [step].
        cause: of the failure, in the words of ``Failure``.
        differences: (step, names of arrays) where the state before a step is not, to the bit, the one that the step
            before led to: a caller wrote into it there, such as a command, or started the world anew. The replay goes
            on from what the file holds.
        failure: what the file holds.
    """

    q: np.ndarray
    qd: np.ndarray
    contact_f: np.ndarray | None
    status: np.ndarray
    reward: np.ndarray
    done: np.ndarray
    cause: str
    differences: list[tuple[int, tuple[str, ...]]]
    failure: Failure

    @property
    def equal(self) -> bool:
        """Whether every step leads to the next state in the file, to the bit, and the last one to the same failure."""
        same = bool((self.status == self.failure.status).all())
        return same and not self.differences and self.cause == self.failure.cause


@torch.inference_mode(False)
def replay_failure(self: Env, file: str | Path) -> ReplayedFailure:
    """Take the last steps of a world that failed again, in an environment of that world alone.

    Args:
        file: that ``keep_failures`` has left, of an environment that was made with the same arguments as this one, but
            for the number of worlds, the seed and the device. This environment is not changed.

    Returns:
        :class:`warp_spo.env.failure_replay.ReplayedFailure`: states, contact forces and status of each step. On the
        same kind of device they are those of the run to the bit, whatever events, delays, curricula and histories there
        are, because a world's numbers do not depend on other worlds. Numbers of a ``TorchTerm`` are those of the file.

    Raises:
        OSError: there is no such file. ValueError: it is none of a failure, or does not fit this environment.
    """
    failure = read(file)
    alone = make_alone(self, failure)
    state = state_arrays(alone)
    own = {name: tuple(x.movedim(axis, 0).shape[1:]) for name, (x, axis) in state.items()}
    own[ACTIONS] = (alone.num_actions,)
    held = {n: tuple(x.shape[1:]) for n, x in failure.arrays.items() if n not in (STATUS, FORCE, JUDGED)}
    if own != held or dict(failure.memory) != {n: x[:2] for n, x in alone._layout.memory.items()}:
        names = sorted(name for name in own.keys() | held.keys() if own.get(name) != held.get(name)) or ["memory"]
        raise ValueError(
            f"Env.replay_failure: {str(file)!r} holds {', '.join(f'{n} {held.get(n, ())}' for n in names)}, this "
            f"environment has {', '.join(f'{n} {own.get(n, ())}' for n in names)}; expected the arguments of the "
            "environment that left the file"
        )
    return _Replay(alone, failure, state).run()


def make_alone(env: Env, failure: Failure) -> Env:
    """Return an environment with the arguments of another one for the world of a failure alone.

    Where the scene has values for each world, other worlds stand beside it, see :func:`rows_beside`. Where the plan of
    the dynamics has another granularity for so few worlds, there are as many as in the run, and the first one counts:
    last bits may depend on it. Terms in torch, which may know the number of worlds, are not called.
    """
    scene, row = env.scene, failure.world - env.first_world
    if scene.worlds > 1 and not 0 <= row < scene.worlds:
        raise ValueError(
            f"Env.replay_failure: the failure is of world {failure.world}, the scene has values for {scene.worlds} "
            "worlds; expected the scene of the environment that left the file"
        )
    alone = _make(env, [0] if scene.worlds == 1 else rows_beside(scene, row))
    if plan_of(alone) != failure.plan:
        alone = _make(env, [(max(row, 0) + i) % scene.worlds for i in range(failure.worlds)])
    alone.first_world = failure.world
    alone.reset(seed=failure.seed)
    return alone


def _make(env: Env, rows: list[int]) -> Env:
    """Return an environment of so many worlds, with the values that ``rows`` have in the scene; it is kept."""
    from .environment import Env as Whole

    key = tuple(rows)
    if key not in env._alone:
        kind = type("EnvOfFailure", (Whole,), {"_fill_in": lambda *_: None})
        own = {"scene": scene_of_rows(env.scene, rows), "worlds": len(rows), "graph": False, "keep_failures": None}
        env._alone = {key: kind(**(env._given | own))}
    return env._alone[key]


def rows_beside(scene: Scene, row: int) -> list[int]:
    """Return a world and others, such that what differs between the worlds of a scene differs between these, too.

    A number that all worlds share is a constant of the kernels, and would have other bits.
    """
    every = np.concatenate([x.reshape(scene.worlds, -1) for x in scene.values.values() if len(x) > 1], axis=1)
    rows, left = [row], (every != every[row]).any(axis=0)
    while left.any():
        rows.append(int((every != every[row])[:, left.argmax()].argmax()))
        left &= every[rows[-1]] == every[row]
    return rows if len(rows) > 1 else [row, row]


class _Replay:
    """The steps of a failure in an environment of its own."""

    def __init__(self, env: Env, failure: Failure, state: dict[str, tuple[torch.Tensor, int]]):
        self.env, self.failure, self.state = env, failure, state
        tensors, like = env._tensors, env.q
        env._status = torch.zeros(env.num_envs, dtype=torch.int32, device=env.device)
        self.force = tensors.get(FORCE)
        if self.force is None and env.scene.contact_count:
            self.force = torch.zeros(env.num_envs, env.scene.contact_count, 3, device=env.device)
            env._report = type(env._report)(**env._report.by_name(), contact_f=self.force)
        self.arrays = {name: x.to(like.device) for name, x in failure.arrays.items()}
        self.parts = env._parts()
        self.after_judge = len(self.parts) - 2 - len(env._user_parts("observe"))

    def run(self) -> ReplayedFailure:
        """Take all steps."""
        env, first = self.env, self.failure.first_step
        q, qd = [self.arrays["q"][0]], [self.arrays["qd"][0]]
        rest: dict[str, list[Any]] = {name: [] for name in ("force", "status", "reward", "done")}
        differences: list[tuple[int, tuple[str, ...]]] = []
        self._restore(0, tuple(self.state))
        for i in range(self.failure.steps):
            different = tuple(name for name in self.state if i and name != USER and not self._is_equal(name, i))
            if different:
                differences.append((first + i, different))
                self._restore(i, different)
            before = env._tensors["faults"][:, 0].clone()
            after_q, after_qd = self._step(i)
            q.append(after_q)
            qd.append(after_qd)
            out = env._store.out
            rest["reward"].append(env._store.part(out, "reward")[0, 0].clone())
            rest["done"].append(bool(env._store.part(out, "done").view(torch.int32)[0, 0]))
            rest["status"].append(int(env._status[0]))  # type: ignore[index]
            rest["force"].append(None if self.force is None else self.force[0].clone())
        status = words_of_states(env.scene, self.arrays["q"].cpu().numpy(), np.array(rest["status"]))
        grown = (env._tensors["faults"][:, 0] > before).nonzero().ravel().tolist()
        cause = env._layout.guard.names[grown[0]] if grown else f"status {Status(status[-1]).name}"
        force = None if self.force is None else torch.stack(rest["force"]).cpu().numpy()
        return ReplayedFailure(
            torch.stack(q).cpu().numpy(), torch.stack(qd).cpu().numpy(), force, status,
            torch.stack(rest["reward"]).cpu().numpy(), np.array(rest["done"]), cause, differences, self.failure,
        )  # fmt: skip

    def _step(self, i: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Take step i, and return the state to which the dynamics led."""
        env, users = self.env, self.env._tensors.get(USER)
        env.actions[:] = self.arrays[ACTIONS][i]
        self.parts[0].run()
        state = env.q[0].clone(), env.qd[0].clone()
        for number, part in enumerate(self.parts[1:], 1):
            late = number >= self.after_judge
            if not part.term:
                part.run()
            elif not late:
                users[:] = self.arrays[JUDGED][i]  # type: ignore[index]
            elif i + 1 < self.failure.steps:
                users[:] = self.arrays[USER][i + 1]  # type: ignore[index]
        return state

    def _restore(self, i: int, names: tuple[str, ...]) -> None:
        """Make the worlds what the file says of them before step i."""
        for name in names:
            tensor, axis = self.state[name]
            tensor.movedim(axis, 0)[:] = self.arrays[name][i]
        if any(name.startswith("value_") for name in names):
            self.env._set_values()

    def _is_equal(self, name: str, i: int) -> bool:
        tensor, axis = self.state[name]
        found, held = tensor.movedim(axis, 0)[0].contiguous(), self.arrays[name][i].contiguous()
        return torch.equal(found.reshape(-1).view(torch.int32), held.reshape(-1).view(torch.int32))
