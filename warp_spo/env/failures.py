"""Records of worlds that fail: a ring of their last states on the device, and a thread that writes files.

A world fails where the guard ends it, or where a step of the dynamics gives it a status from CONTACT on by severity.
The device copies the ring of such a world aside within the step; the host learns of it by a number that the device
writes to pinned memory then. So a step in which nothing fails takes two launches, of which one runs beside others, and
waits for nobody; it does not matter how far the host is ahead.
"""

from __future__ import annotations

import dataclasses
import math
import os
import pickle
import warnings
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp

from ..execution.status_words import words_of_states
from ..kernels import failure_ring as kernels
from ..runtime import launches
from ..scene.scene import Scene
from ..status import Status
from . import training_files
from .compile.buffers import FAULT, ring_name

if TYPE_CHECKING:
    from .environment import Env

SLOTS = 50  # steps of the ring
FILES, FILES_OF_A_CAUSE = 20, 4  # of an environment; of the same cause
FORMAT = 1  # of files
STATUS, FORCE, ACTIONS, USER, JUDGED = "status", "contact_f", "actions", "user", "user of judge"
SHOWN = (STATUS, FORCE)  # what a file holds of the step before, for those who look
WORD = 4  # bytes


@dataclasses.dataclass(frozen=True)
class RingArray:
    """An array of worlds as the ring holds it.

    Attributes:
        tensor: [world, ...], or with ``axis`` 1 [entry, world]. axis: of worlds. first: word in a slot.
        words: of a world.
    """

    tensor: torch.Tensor
    axis: int
    first: int

    @property
    def worlds(self) -> int:
        """How many worlds it has."""
        return self.tensor.shape[self.axis]

    @property
    def words(self) -> int:
        """Words of 32 bits that a world has."""
        return self.tensor.nbytes // WORD // self.worlds

    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Return where the words of world 0 are in a slot, and how far those of the next world are from them."""
        words = np.arange(self.words)
        if self.axis:
            return self.first + words * self.worlds, np.ones_like(words)
        return self.first + words, np.full_like(words, self.words)

    def of_rows(self, rows: torch.Tensor) -> torch.Tensor:
        """Return this array [step, ...] of words [step, word] of a world."""
        shape = [size for axis, size in enumerate(self.tensor.shape) if axis != self.axis]
        whole = rows.clone(memory_format=torch.contiguous_format).reshape(-1)  # aligned for 64 bits
        return whole.view(self.tensor.dtype).reshape(len(rows), *shape)


def state_arrays(env: Env) -> dict[str, tuple[torch.Tensor, int]]:
    """Return the tensors that decide how a world goes on, each with its axis of worlds, by name.

    What the dynamics or a later stage of a step write before anything reads it is not among them; nor are actions.
    """
    own = {"q", "qd", "memory", "found", "tick", "episode_length", *(f"value_{name}" for name in env.values)}
    own |= env._read_first - {ACTIONS} | {ring_name(number) for number in range(len(env._learned))}
    found = {name: each for name, each in env._store.worlds_of().items() if name in own and each[0].numel()}
    if env._layout.users:
        found[USER] = env._tensors[USER], 0
    parts = enumerate(env._actuator_state or ())
    return found | {f"actuator state {i}": (part, 0) for i, part in parts if part.numel()}


class FailureRing:
    """The last states of all worlds of an environment, and the files of those that failed.

    Args:
        env: the environment. folder: of the files, made where it is missing.

    Attributes:
        status: of the last step [world], int32. bytes: of device memory. files: those that were written.

    Raises:
        OSError: the folder cannot be written; the message says what to do.
    """

    def __init__(self, env: Env, folder: str | Path):
        self.folder = check_failure_folder(folder)
        self.files: list[Path] = []
        self._device, self._wp_device, self._stream = env.device, env.warp_device, env._stream
        self.status = torch.zeros(env.num_envs, dtype=torch.int32, device=env.device)
        self._arrays = self._place(env)
        self._facts = facts(env)
        self._scene: tuple[Any, Any] = env.scene, {}
        self._first_world, self._first_step, self._seed = env.first_world, env._steps, env.seed
        self._guard = list(env._layout.guard.names)
        last = max(self._arrays.values(), key=lambda each: each.first)
        self._words = _round_up(last.first + last.tensor.nbytes // WORD)
        self._fault = env._tensors[FAULT]
        self._make_memory(env.num_envs)
        self.clear()
        self._pool: ThreadPoolExecutor | None = None
        self._waiting: list[Future] = []
        self._handed, self._trouble, self._warned = 0, "", False

    def _place(self, env: Env) -> dict[str, RingArray]:
        """Return the arrays of a slot by name, one after the other, each from a multiple of four words on."""
        every = {ACTIONS: (env.actions, 0), **state_arrays(env), STATUS: (self.status, 0)}
        if FORCE in env._tensors:
            every[FORCE] = env._tensors[FORCE], 0
        if env._layout.users:
            every[JUDGED] = env._tensors[USER], 0
        found: dict[str, RingArray] = {}
        at = 0
        for name, (tensor, axis) in every.items():
            found[name] = RingArray(tensor, axis, at)
            at = _round_up(at + tensor.nbytes // WORD)
        return found

    def _make_memory(self, worlds: int) -> None:
        def zeros(*shape: int) -> torch.Tensor:
            return torch.zeros(shape, dtype=torch.int32, device=self._device)

        places, pitches = zip(*(each.places() for each in self._arrays.values()), strict=True)
        kinds = len(self._guard) + len(Status)
        self._counted = sum(1 << each for each in Status if each.severity >= Status.CONTACT.severity)
        self._ring = zeros(SLOTS, self._words)
        self._rows = zeros(FILES, SLOTS, sum(each.words for each in self._arrays.values()))
        self._chosen = zeros(FILES, 4)
        self._clock, self._until = zeros(1), zeros(worlds)
        own = dict(
            taken=zeros(kinds), first=zeros(kinds), status=self.status, until=self._until, latest=zeros(worlds),
            clock=self._clock, files=zeros(1), chosen=self._chosen, rows=self._rows, fault=self._fault,
        )  # fmt: skip
        self._own = own
        self._wp = {name: wp.from_torch(tensor) for name, tensor in own.items()}
        self._wp["place"] = wp.array(np.concatenate(places), dtype=wp.int64, device=self._wp_device)
        self._wp["pitch"] = wp.array(np.concatenate(pitches), dtype=wp.int32, device=self._wp_device)
        pinned = self._device.type == "cuda"
        self._told = torch.zeros(1, dtype=torch.int32, pin_memory=pinned)
        self._told_files = self._told.numpy()
        self._host = [torch.empty_like(x[0], device="cpu", pin_memory=pinned) for x in (self._rows, self._chosen)]
        self.bytes = sum(x.nbytes for x in (self._ring, self._rows, self._until, self.status))
        self._chunks = [
            self._cut([name for name in self._arrays if (name == JUDGED) == late]) for late in (False, True)
        ]

    def _cut(self, names: list[str]) -> list[wp.array]:
        """Return addresses, words and places in a slot of the chunks of arrays."""
        found: list[tuple[int, int, int]] = []
        for name in names:
            each = self._arrays[name]
            words, start = each.tensor.nbytes // WORD, each.tensor.data_ptr()
            for at in range(0, words, kernels.CHUNK):
                found.append((start + WORD * at, min(kernels.CHUNK, words - at), each.first + at))
        columns = zip(*found, strict=True) if found else ((), (), ())
        types = (wp.uint64, wp.int32, wp.int64)
        return [wp.array(list(x), dtype=kind, device=self._wp_device) for x, kind in zip(columns, types, strict=True)]

    def describe(self) -> str:
        """Return in words what is kept, where, and what it takes."""
        each = WORD * sum(one.words for one in self._arrays.values())
        return (
            f"the last {SLOTS} steps, {each} bytes a step and world, {self.bytes / 1e6:.3g} MB in all; at most {FILES} "
            f"files, {FILES_OF_A_CAUSE} of a cause, in {str(self.folder)!r}"
        )

    # -- in a step -------------------------------------------------------------------------------------------------
    def keep(self) -> None:
        """Copy the state of all worlds and their actions, before a step."""
        self._copy(self._chunks[0])

    def keep_judged(self) -> None:
        """Copy what the user's terms in torch have given for "judge"."""
        self._copy(self._chunks[1])

    def _copy(self, chunks: list[wp.array]) -> None:
        dim = len(chunks[0]), kernels.CHUNK // kernels.QUAD
        inputs = [*chunks, self._wp["clock"], SLOTS, self._words, self._ring.data_ptr()]
        self._launch(kernels.copy_state(), dim, inputs, [])

    def find(self) -> None:
        """Find worlds that have failed in this step, and copy their rings aside."""
        own, threads = self._wp, kernels.THREADS if self._device.type == "cuda" else 1
        ring = [SLOTS, self._words, self._ring.data_ptr(), own["place"], own["pitch"]]
        failed = [own["fault"], own["status"], len(self._guard), self._counted, FILES_OF_A_CAUSE]
        names = ("taken", "until", "latest", "first", "clock", "files", "chosen", "rows")
        written = [*(own[name] for name in names), self._told.data_ptr()]
        self._launch(kernels.find_failures(), threads, [threads, *ring, *failed], written, threads)

    def _launch(self, kernel: wp.Kernel, dim: Any, inputs: list, outputs: list, block_dim: int = 256) -> None:
        with self._stream():
            launches.launch(kernel, dim, inputs, outputs, device=self._wp_device, block_dim=block_dim)

    def clear(self) -> None:
        """Forget all that was found."""
        for name in ("taken", "until", "clock", "files"):
            self._own[name].zero_()
        self._own["first"].fill_(kernels.NOBODY)
        self._told.zero_()

    # -- on the host -----------------------------------------------------------------------------------------------
    def look(self) -> None:
        """Let the thread write the failures that the device has told of; warn once of a file that was not written."""
        count = int(self._told_files[0])
        while self._handed < count:
            if self._pool is None:
                self._pool = ThreadPoolExecutor(1, "warp_spo failures")
            told = {"seed": self._seed, "first step": self._first_step}
            self._waiting.append(self._pool.submit(self._write, self._handed, told))
            self._handed += 1
        if self._trouble and not self._warned:
            self._warned = True
            warnings.warn(
                f"Env: a failure could not be written into {str(self.folder)!r} ({self._trouble}); all goes on "
                "without its file; make room, or make the environment with another keep_failures",
                stacklevel=3,
            )

    def restart(self, seed: int, steps: int) -> None:
        """Forget the states of all worlds; from now on random numbers are of a seed, and steps count from ``steps``."""
        self._collect()
        self._clock.zero_()
        self._until.zero_()
        self._seed, self._first_step = seed, steps

    def finish(self) -> list[Path]:
        """Wait for the device and the thread, and return the files."""
        self._collect()
        for each in self._waiting:
            each.result()
        self._waiting.clear()
        self.look()
        return list(self.files)

    def _collect(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        self.look()

    # -- in the thread ---------------------------------------------------------------------------------------------
    def _write(self, row: int, told: dict[str, int]) -> None:
        """Write the file of a row."""
        try:
            contents = self._contents(row, told)
            file = self.folder / f"world_{contents['world']:05d}_step_{contents['step']:06d}.pt"
            number = 2
            while file.exists():
                file = file.with_name(f"{file.stem.partition('-')[0]}-{number}.pt")
                number += 1
            training_files.write(file, contents)
            self.files.append(file)
        except Exception as error:  # nobody waits for this thread; the next look tells
            self._trouble = self._trouble or getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"

    def _contents(self, row: int, told: dict[str, int]) -> dict[str, Any]:
        rows, chosen = self._fetch(row)
        world, step, cause, status = chosen.tolist()
        held, at = min(step + 1, SLOTS), 0
        arrays: dict[str, torch.Tensor] = {}
        for name, each in self._arrays.items():
            arrays[name] = each.of_rows(rows[:held, at : at + each.words])
            at += each.words
        words = np.append(arrays[STATUS][1:].numpy(), status)  # a slot holds that of the step before
        arrays[STATUS] = torch.from_numpy(words_of_states(self._scene[0], arrays["q"].numpy(), words))
        status = int(arrays[STATUS][-1])
        name = self._guard[cause] if cause < len(self._guard) else f"status {Status(status).name}"
        scene = self._pickled_scene(world)
        return self._facts | {
            "cause": name, "world": self._first_world + world, "row": world, "seed": told["seed"],
            "step": told["first step"] + step, "arrays": arrays, "scene": scene,
        }  # fmt: skip

    def _fetch(self, row: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the ring of a row and what was chosen, on the host; on CUDA by a stream of this thread's own."""
        given = self._rows[row], self._chosen[row]
        if self._device.type != "cuda":
            return given[0].clone(), given[1].clone()
        with torch.cuda.device(self._device), torch.cuda.stream(torch.cuda.Stream(self._device)):
            for host, each in zip(self._host, given, strict=True):
                host.copy_(each, non_blocking=True)
            event = torch.cuda.Event()
            event.record()
            event.synchronize()  # this thread alone waits
        return self._host[0].clone(), self._host[1].clone()

    def _pickled_scene(self, world: int) -> torch.Tensor | str:
        """Return the scene with the values that a world was given, pickled; in words why it cannot be."""
        scene, known = self._scene
        row = world if scene.worlds > 1 else 0
        if row not in known:
            try:
                data = pickle.dumps(scene_of_rows(scene, [row]))
                known[row] = torch.frombuffer(bytearray(data), dtype=torch.uint8)
            except Exception as error:
                known[row] = str(error)
        return known[row]


def facts(env: Env) -> dict[str, Any]:
    """Return what files of an environment have in common: texts and numbers."""
    scene = env.scene
    coordinates = [
        label if hinge.coord_count == 1 else f"{label}[{i}]"
        for label, hinge in zip(scene.joint_labels, scene.hinges, strict=True)
        for i in range(hinge.coord_count)
    ]
    return {
        "format": FORMAT, "what": "failure of a world", "versions": training_files.versions(),
        "worlds": env.num_envs, "device": str(env.warp_device), "dt": env.dt, "decimation": env.decimation,
        "plan": plan_of(env),
        "memory": {name: [start, size] for name, (start, size, _) in env._layout.memory.items()},
        "labels": {"actions": env.action_labels, "q": coordinates, "qd": list(scene.dof_labels)},
    }  # fmt: skip


def plan_of(env: Env) -> list[Any]:
    """Return what the plan chooses by the number of worlds, and what last bits depend on."""
    plan = env.dyn.plan
    return [plan.granularity, plan.block_length, plan.device.cuda and plan.latency_bound]


def scene_of_rows(scene: Scene, rows: list[int]) -> Scene:
    """Return a scene of as many worlds as ``rows``, with the values that these worlds have in a scene of many."""
    if scene.worlds == 1:
        return scene
    found = object.__new__(Scene)
    found.__dict__.update(scene.__dict__)
    found.values = type(scene.values)({n: x[rows] if len(x) > 1 else x for n, x in scene.values.items()})
    found.q_index, found.dof_index = (
        np.arange(len(rows) * count).reshape(len(rows), -1) for count in (scene.coord_count, scene.dof_count)
    )
    return found


def check_failure_folder(folder: Any) -> Path:
    """Return a folder in which files can be written.

    Raises:
        TypeError: it is no path. OSError: it cannot be made, or takes no files.
    """
    if not isinstance(folder, str | Path) or not str(folder):
        raise TypeError(f"Env: keep_failures is {folder!r}; expected a folder, such as 'failures', or None")
    path = Path(folder)
    probe = path / f".probe-{os.getpid()}"  # processes of a training share the folder
    try:
        path.mkdir(parents=True, exist_ok=True)
        training_files.write_bytes(probe, bytes(1 << 16))
        probe.unlink()
    except OSError as error:
        raise OSError(
            f"Env: keep_failures is {str(path)!r}, where no file can be written ({error.strerror or error}); expected "
            "a folder with room for files; give another one, or None"
        ) from None
    return path


def _round_up(words: int) -> int:
    """Return the least multiple of QUAD that is not below a number of words."""
    return math.ceil(words / kernels.QUAD) * kernels.QUAD
