"""An environment of many worlds: ``Env``."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from ..dynamics.dynamics import Dynamics
from ..dynamics.stepping.joint_space import check_pair_solver
from ..dynamics.stepping.options import StepOptions, StepReport
from ..errors import shown
from ..execution.device_facts import read_facts
from ..recursions.contact.ground import GROUND, SINGLE
from ..runtime.arrays import parse_device
from ..runtime.launches import compile_side_by_side
from ..runtime.torch_tensors import stream
from ..scene.scene import Scene
from . import arguments, checkpoint, failure_replay, seeding
from .actions import ActuatorNet
from .bounds import Bounds
from .commands import COMMAND, HELD
from .compile.actuator_launches import ActuatorLaunches
from .compile.buffers import Storage
from .compile.cuda_graphs import Part, Replay, run_all
from .compile.fused_kernel import Launch
from .compile.guard import Guard
from .compile.memory_layout import MemoryLayout
from .compile.start_steps import StartSteps
from .compile.step_kernels import Tracing
from .curricula import ends_of
from .episode_log import Log, describe, explain
from .events import Delays, Values, changed_values
from .failures import FailureRing
from .held_tensor import HeldTensor
from .observations import TorchTerm
from .validation import check_whole
from .world_values import WorldValues

try:
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict
except ImportError:  # optional packages
    VecEnv, TensorDict = object, None  # type: ignore[assignment,misc]

SIDE_BY_SIDE_WORLDS = 16384  # up to which kernels of a stage do not fill a GPU each by itself


class Env(VecEnv):
    """An environment of many worlds for reinforcement learning; an rsl_rl ``VecEnv``.

    A step takes ``decimation`` steps of the dynamics with the same controls, computes rewards and terminations, starts
    worlds anew whose episode has ended, and observes. The observation of such a world is the first of its new episode.
    On CUDA all of it is one graph.

    Args:
        scene: the scene, of one world.
        worlds: number of worlds.
        device: Warp or torch device.
        dt: length of a step of the dynamics [s].
        decimation: steps of the dynamics in one step of the environment.
        actions: one of :mod:`warp_spo.env.actions`, or several; the policy's numbers are theirs, one after the other.
        observations: for each group a list of terms, functions of a ``World`` or ``Observation``.
        rewards: (weight, term) by name. The reward is the sum of weight times term times the length of the step.
            A weight is a number or a ``Curriculum`` of :mod:`warp_spo.env.curricula`.
        terminations: terms by name.
        metrics: terms by name whose means over episodes are logged; nothing else depends on them.
        commands: None, or one of :mod:`warp_spo.env.commands`.
        events: of :mod:`warp_spo.env.events`.
        episode_length_s: after this time, rounded up to whole steps, an episode ends with a time-out [s].
        default_q: coordinates [coordinate] of starts, to which joints and actions are relative; None: the scene's.
        seed: of all random numbers, 64 bits.
        first_world: number of world 0 in a run on several devices; a world's numbers depend on its own number alone.
        passes: of steps with contacts, see :meth:`Dynamics.step`.
        granularity, pair_solver: of the dynamics, see :class:`warp_spo.Dynamics`.
        graph: whether a step is one CUDA graph; None: on CUDA it is.
        final_observations: whether ``extras["final_observations"]`` holds what was observed after the step and before
            new starts, the last observation of worlds whose episode has ended.
        bounds: sizes of actions, states, observations and rewards that end a world; None: those of ``Bounds``.
        log_interval: steps after which ``extras["log"]`` comes again.
        keep_failures: None, or a folder: a world that fails leaves a file there, from which :meth:`replay_failure`
            steps it again. It fails where the guard ends it, or where a step's status is CONTACT or a more severe one.

    Attributes:
        q, qd: state, torch tensors [world, coordinate] and [world, dof].
        final: the argument ``final_observations``. bounds: those that end worlds.
        replay: runs a step without its inputs and results; ``replay.captured`` says of how many graphs it is made.
        values: what events have made of the scene's values, torch tensors [world, ...] by name. Numbers that
            torch writes there count for terms and for the dynamics from the next step on, until an event draws the
            value anew. They have no gradient; a tensor that requires grad is refused.
        dyn: the :class:`Dynamics`. has_commands: whether it gives commands.
        action_labels, action_clips: of each action, what it sets, and None or the (lowest, highest) that counts.
        options: with which a task has changed its arguments, see ``settings.make_env``; {} without a task.
        observation_terms: of each group (name, size, ``Observation``) of its terms, in their order.
        num_envs, num_actions, num_obs, max_episode_length, episode_length_buf, device, cfg: as rsl_rl names them.

    Raises:
        ValueError, TypeError: an argument is invalid; the message names it.
    """

    @torch.inference_mode(False)  # tensors of inference could not be written outside of it
    def __init__(
        self,
        scene: Scene,
        worlds: int,
        device: Any = None,
        *,
        dt: float = 5e-3,
        decimation: int = 4,
        actions: Any,
        observations: Mapping[str, Sequence[Any]],
        rewards: Mapping[str, tuple[Any, Callable]],
        terminations: Mapping[str, Callable] | None = None,
        metrics: Mapping[str, Callable] | None = None,
        commands: Any = None,
        events: Sequence[Any] = (),
        episode_length_s: float = 20.0,
        default_q: Any = None,
        seed: int = 0,
        first_world: int = 0,
        passes: int | None = None,
        granularity: str | None = None,
        graph: bool | None = None,
        log_interval: int = 24,
        final_observations: bool = False,
        bounds: Bounds | None = None,
        cfg: Any = None,
        keep_failures: str | Path | None = None,
        pair_solver: str | None = None,
    ):
        self._given = {name: value for name, value in locals().items() if name != "self"}
        self._alone: dict[tuple[int, ...], Env] = {}  # of one world, for replays of failures
        self.scene, self.num_envs = arguments.check_scene(scene), worlds
        self.warp_device = parse_device(str(device) if device is not None else None, "Env")
        self.device = torch.device(wp.device_to_torch(self.warp_device))
        self.dt, self.decimation, self.max_episode_length = arguments.check_times(dt, decimation, episode_length_s)
        self.step_dt = self.dt * self.decimation
        self.first_world = check_whole("Env", "first_world", first_world, 0, 2**32 - 1)
        self.seed, self.cfg = check_whole("Env", "seed", seed, 0, 2**64 - 1), {} if cfg is None else cfg
        self.options: dict[str, Any] = {}
        self.log_interval = check_whole("Env", "log_interval", log_interval, 1)
        self._passes, self.has_commands = arguments.check_passes(scene, passes), commands is not None
        self.final = arguments.check_bool("final_observations", final_observations)
        default, commands = arguments.check_default(scene, default_q), arguments.check_commands(commands)
        terms = arguments.check_terms(observations, rewards, terminations or {}, metrics or {}, events)
        self.bounds = arguments.check_bounds(bounds)
        guard = Guard(self.bounds.limits(scene, self.dt, episode_length_s, list(terms[1]), terms[0]))
        times, changed = (self.step_dt, self.dt), changed_values(scene, events)
        self._layout = MemoryLayout(scene, default, *times, commands, changed, guard)
        self._layout.keeps_failures = keep_failures is not None
        tracing = self._trace(arguments.check_parts(actions), *terms, commands, events)
        variable = self._layout.values
        check_pair_solver("Env", pair_solver)
        options: dict[str, Any] = {"granularity": granularity, "pair_solver": pair_solver}
        self.dyn = Dynamics(scene, worlds, self.warp_device, "float32", variable, **options)
        self.dyn._checks_results = False  # the guard looks at them
        store = self._store = self._allocate(tracing)
        self.q, self.qd, self.actions, self.chosen = (store.tensors[n] for n in ("q", "qd", "actions", "chosen"))
        self._tensors, self._controls, self._report = store.tensors, store.controls, StepReport(**store.written)
        self.values, longest = WorldValues(store.values), self._longest_delay(events)
        self._actuator_state = self.dyn.actuator_state(like=self.q, longest=longest) if longest else None
        self._networks = self._actuator_launches()  # None: the kernel of the step evaluates networks, or there are none
        substeps = self.decimation if self._networks is None else 1
        self._step_options = StepOptions(substeps=substeps, passes=self._passes)
        self._log = Log(self._layout, self.reward_names, self.termination_names, self.device, worlds)
        points, seen = len(scene.contact_points), tracing.observed_entries
        of_pairs = any(array == "contact_gap" and entry >= points for array, entry in seen)
        moves = any(array == "frame_acceleration" for array, _ in seen)
        self._start_steps = StartSteps(self, longest, of_pairs, moves)
        self._kernels = self._build(tracing)
        self._read_first, self._steps = tracing.stages["act"].read_arrays(), 0
        self._failures = None if keep_failures is None else FailureRing(self, keep_failures)
        self._status = None if self._failures is None else self._failures.status
        wanted = graph is None or arguments.check_bool("graph", graph)
        self.replay = Replay(self._parts(), wanted and self.warp_device.is_cuda)
        if self.warp_device.is_cuda:
            self._compile()
        self.reset(seed=seed)

    def _trace(
        self, actions: Any, groups: Any, rewards: Any, terminations: Any, metrics: Any, commands: Any, events: Any
    ) -> Tracing:
        """Return the traced stages of the checked terms; keep the names and counts of their numbers."""
        layout = self._layout
        self.action_labels = [label for part in actions for label in part.labels(self.scene)]
        self.action_clips = [part.clip for part in actions for _ in part.labels(self.scene)]
        self.num_actions = layout.action_count = len(self.action_labels)
        layout.action_arrays = {part.array for part in actions}
        self._learned = [part for part in actions if isinstance(part, ActuatorNet)]
        layout.networks = [(len(part.hinges(self.scene)), max(part.network.input_idx)) for part in self._learned]
        layout.action_arrays |= {"tau"} if self._learned else set()
        tracing = Tracing(layout, actions, groups, rewards, terminations, metrics, commands, list(events))
        tracing.run(self.max_episode_length, self.final)
        self.reward_names, self.termination_names = list(rewards), tracing.ends
        self.observation_terms = tracing.observation_terms
        self.num_obs, self._levels = tracing.group_sizes, checkpoint.level_names(events, commands, layout.levels)
        self._values_later = any(isinstance(event, Values) and event.when != "start" for event in events)
        return tracing

    def _allocate(self, tracing: Tracing) -> Storage:
        """Return the arrays that the traced stages and the dynamics read and write."""
        finals = [(f"final {name}", size) for name, size in self.num_obs.items()] if self.final else []
        results = [*((name, 1) for name in arguments.RESULTS), *self.num_obs.items(), *finals]
        of_ground = {GROUND: "ground_cells", SINGLE: "ground_heights"}  # the same memory that the dynamics read
        held = self.dyn.recursions.parameters
        tables = {name: wp.to_torch(getattr(held, of_ground[name])) for name in of_ground.keys() & tracing.tables}
        return Storage(self._layout, self.num_envs, self.device, tracing.arrays, results, tracing.apart, tables)

    def _actuator_launches(self) -> ActuatorLaunches | None:
        """Return the kernels of learned actuators, None where there are none beside that of the step."""
        if not self._learned:
            return None
        found = ActuatorLaunches(self._learned, self._layout, self._store, self.decimation, self.warp_device)
        given = "ctrl" in self._controls, self._actuator_state is not None, self._passes
        return None if found.join(self.dyn, *given) else found

    def _longest_delay(self, events: Sequence[Any]) -> int:
        """Return the longest delay of actuators [steps of the dynamics], 0 where there are none."""
        delays = [int(each) for each in self.scene.values["actuator_delay"].ravel()]
        delays += [event.longest for event in events if isinstance(event, Delays)]
        return max(delays, default=0) if "ctrl" in self._controls else 0

    # -- numbers that may be written --------------------------------------------------------------------------------
    set_seed = seeding.set_seed

    def take_written_values(self) -> None:
        """Copy to the dynamics what has been written into ``values``; steps do so, but for a graph of many.

        Raises:
            ValueError: the tensor that was written there, or into another of the environment's, requires grad.
        """
        arguments.refuse_written_gradients(self)
        if self.values.were_written():
            self._set_values()

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Steps since the start of the episode, int64 [world]. Logs leave out episodes whose entry a caller wrote."""
        return self._tensors["episode_length"]

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        checkpoint.write_lengths(self, value)

    @property
    def default_q(self) -> np.ndarray:
        """The coordinates that episodes start from [coordinate]."""
        return self._layout.default_q

    @property
    def is_capturable(self) -> bool:
        """Whether a CUDA graph can hold steps in a row, known after the first one; not where ``step`` is replaced."""
        return getattr(self.step, "__func__", None) is Env.step and self.replay.is_capturable

    @property
    def unwrapped(self) -> Env:
        """This environment."""
        return self

    def memory(self, name: str) -> torch.Tensor:
        """Return what worlds remember under a name, such as "command", as a tensor that may be written [world, n]."""
        if name not in self._layout.memory:
            raise ValueError(
                f"Env.memory: unknown name {name!r}; expected one of {', '.join(map(shown, self._layout.memory))}"
            )
        start, size, _ = self._layout.memory[name]
        found = self._tensors["memory"][start : start + size].t()
        return HeldTensor.of(found, self.memory(HELD)) if name == COMMAND and self.has_commands else found

    @property
    def command(self) -> torch.Tensor:
        """The commands [world, command]; they may be written.

        What is written is held from then on, through redraws, headings and new episodes, until a ``reset`` with a seed,
        or until ``env.memory("command held")`` [world, command], 1 where a number is held, is set to 0.
        """
        if not self.has_commands:
            raise ValueError(
                "Env.command: this environment gives no commands; expected one that was made with commands="
            )
        return self.memory(COMMAND)

    @command.setter
    def command(self, value: Any) -> None:
        self.command[:] = arguments.check_written("env.command", value, self.command)

    @property
    def command_ranges(self) -> dict[str, tuple[float, float]]:
        """Ranges of the numbers of a command by name; -1 to 1 for commands of one's own without ``ranges_by_name``.

        Of a curriculum, from the lowest to the highest of both its ranges.
        """
        commands = self._layout.commands
        plain = {f"command {i}": (-1.0, 1.0) for i in range(commands.size if self.has_commands else 0)}
        ends = {name: np.array(ends_of(each)) for name, each in getattr(commands, "ranges_by_name", plain).items()}
        return {name: (float(each.min()), float(each.max())) for name, each in ends.items()}

    # -- stepping --------------------------------------------------------------------------------------------------
    def get_observations(self) -> Any:
        """Return the observations of the last step or reset, a TensorDict of [world, number] by group."""
        return self._observations(self._store.out.clone())

    def reset(self, mask: torch.Tensor | None = None, seed: int | Sequence[int] | None = None) -> tuple[Any, dict]:
        """Start worlds anew, and return observations and an empty dictionary.

        Args:
            mask: bool [world], the worlds; None: all.
            seed: None: random numbers go on. A seed as in :meth:`set_seed` makes of this a new environment of that
                seed, to the bit: what is drawn at the "start" is drawn anew, and levels and logs begin again.

        Raises:
            ValueError: the mask or a seed is none, or both are given: a seed is for all worlds.
        """
        if seed is not None:
            if mask is not None:
                raise ValueError("Env.reset: got mask and seed; expected one of them: a seed starts all worlds anew")
            seeding.begin(self, seed)
        if mask is None:
            self.chosen.fill_(True)
        else:
            mask = arguments.check_mask("Env.reset", mask, self.num_envs, self.device)
            self.chosen.copy_(mask)
        before = self._store.out.clone()
        self.take_written_values()
        self._launch("reset")
        self._after_reset()
        for part in self._user_parts("observe"):
            part.run()
        self._tensors["advance"].fill_(0.0)
        self._launch("observe")
        self._tensors["advance"].fill_(1.0)
        if mask is not None:
            for name in self.num_obs:  # others have seen nothing new
                new, old = (self._store.part(out, name) for out in (self._store.out, before))
                new.copy_(torch.where(mask[:, None], new, old))
        return self.get_observations(), {}

    def step(self, actions: torch.Tensor) -> tuple[Any, torch.Tensor, torch.Tensor, dict]:
        """Take one step in all worlds.

        Args:
            actions: [world, action], a tensor or an array, on any device. A world whose actions are not finite, or
                beyond their bound, starts anew, and is counted.

        Returns:
            Observations by group; rewards [world]; whether the episode ended, int [world]; a dictionary with
            ``time_outs`` [world], 1 where it ended for its length alone, and now and then ``log``.
        """
        self.actions.copy_(arguments.check_actions("Env.step", actions, self.num_envs, self.action_labels))
        self.take_written_values()
        self.replay()
        self._steps += 1
        self.write_failures()
        out = self._store.out.clone()
        extras: dict[str, Any] = {"time_outs": self._store.part(out, "time_out").view(-1)}
        if self._steps % self.log_interval == 0:
            extras["log"] = self.log()
        if self.final:
            extras["final_observations"] = self._observations(out, "final ")
        done = self._store.part(out, "done").view(-1).view(torch.int32)
        return self._observations(out), self._store.part(out, "reward").view(-1), done, extras

    def controls(self, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return what actions set, "ctrl", "target_q" or "tau" [world, ...]; worlds remember them as their actions."""
        self.actions.copy_(arguments.check_actions("Env.controls", actions, self.num_envs, self.action_labels))
        self._after("act")
        self._launch("act")
        return {name: controls.clone() for name, controls in self._controls.items()}

    def log(self) -> dict[str, torch.Tensor]:
        """Return means over worlds' last finished episodes by name, and counts: ``warp_spo.env.episode_log.Log``."""
        return self._log(self._tensors["memory"], self._tensors["faults"])

    def explain(self) -> str:
        """Return what a step consists of, and what it takes in memory."""
        return explain(self, self._kernels, self._layout.users)

    @property
    def bytes_per_world(self) -> int:
        """Bytes of device memory that a world takes after a step, without what all worlds share."""
        delays = 0 if self._actuator_state is None else sum(part.nbytes for part in self._actuator_state)
        run = self.dyn.recursions
        own = self._store.bytes_per_world + run.parameters.bytes_per_world
        return own + (delays + run.workspace_bytes) // self.num_envs

    def close(self) -> None:
        """Wait for files of failures that are being written; memory is freed with the object."""
        self.failure_files()

    def write_failures(self) -> None:
        """Let a thread write what the device has told of worlds that failed; steps do so, but for a graph of many."""
        if self._failures is not None:
            self._failures.look()

    def failure_files(self) -> list[Path]:
        """Wait for the device, and return the files of ``keep_failures`` that this environment has written."""
        return [] if self._failures is None else self._failures.finish()

    # -- state outside of it ---------------------------------------------------------------------------------------
    levels = checkpoint.levels
    start_at = checkpoint.start_at
    state_dict = checkpoint.state_dict
    load_state_dict = checkpoint.load_state_dict
    replay_failure = failure_replay.replay_failure
    __reduce__, __repr__ = checkpoint.reduce, describe

    # -- inside ----------------------------------------------------------------------------------------------------
    def _observations(self, out: torch.Tensor, kind: str = "") -> Any:
        groups = {name: self._store.part(out, kind + name) for name in self.num_obs}
        return groups if TensorDict is None else TensorDict(groups, batch_size=[self.num_envs], device=self.device)

    def _stream(self) -> Any:
        """Return a context in which Warp launches on torch's current stream."""
        if not self.warp_device.is_cuda:
            return wp.ScopedDevice(self.warp_device)
        return wp.ScopedStream(stream(self.warp_device), sync_enter=False)

    def _build(self, tracing: Tracing) -> dict[str, list[Launch]]:
        """Return the kernels of each stage: that of a thread a world first, unless it overwrites what others read."""
        found: dict[str, list[Launch]] = {stage.name: [] for stage in tracing.stages.values()}
        in_turn = self._in_turn = tracing.in_turn
        self._few = self.num_envs <= read_facts(self.warp_device).scaled(SIDE_BY_SIDE_WORLDS)
        for stage in sorted(tracing.stages.values(), key=lambda each: (each.rows == 0) == (each.name in in_turn)):
            launch = stage.build(self._store.buffers, self.warp_device)
            found[stage.name] += [] if launch is None else [launch]
        return found

    def _launch(self, name: str) -> None:
        """Launch the kernels of a stage ("act", "judge", "observe", ...) on all worlds, on torch's current stream.

        A CUDA graph that is being captured holds them side by side if the worlds are too few for one kernel to fill the
        GPU, and no kernel overwrites what another one reads. Otherwise they run one after the other.
        """

        def run(kernel: Launch) -> None:
            with self._stream():
                kernel(self.num_envs)

        works = [functools.partial(run, kernel) for kernel in self._kernels[name]]
        run_all(works, self.device if self._few and name not in self._in_turn else None)

    def _compile(self) -> None:
        """Compile all kernels side by side, by a step in which nothing counts."""
        torch.cuda.synchronize(self.device)
        with compile_side_by_side():
            for name in self._kernels:
                self._after(name)
                self._launch(name)
            self._physics()
            self._after_reset()
            if self._failures is not None:
                self._failures.find()
        torch.cuda.synchronize(self.device)
        if self._failures is not None:
            self._failures.clear()

    def _parts(self) -> list[Part]:
        """Return the parts of a step in order: the dynamics, last observations, judgement, new starts, observations."""
        after = [Part(lambda: self._after("judge")), *self._user_parts("judge")]
        last = [Part(self._after_reset), *self._user_parts("observe"), Part(self._observe)]
        final = [*self._user_parts("observe"), Part(self._observe_final)] if self.final else []
        return [Part(self._physics), *final, *after, Part(self._judge), *last]

    def _physics(self) -> None:
        """Compute the controls from the actions, and step the dynamics of all worlds in place."""
        if self._failures is not None:
            self._failures.keep()
        self._after("act")
        self._launch("act")
        controls = self._controls
        if self._networks is None:
            self._step_dynamics(controls)
        else:
            self._networks.run(lambda: self._step_dynamics(controls), self._stream)
        if "actuator_force" in self._tensors:
            self.dyn.actuator_force(self.q, self.qd, controls["ctrl"], out=self._tensors["actuator_force"])

    def _step_dynamics(self, controls: dict[str, torch.Tensor]) -> None:
        """Take the steps of the dynamics that have the same controls."""
        self.dyn.step(
            self.q,
            self.qd,
            controls.get("tau"),
            self.dt,
            ctrl=controls.get("ctrl"),
            target_q=controls.get("target_q"),
            actuator_state=self._actuator_state,
            options=self._step_options,
            status=self._status,
            report=self._report,
            out=(self.q, self.qd),
        )

    def _judge(self) -> None:
        if self._failures is not None and self._layout.users:
            self._failures.keep_judged()
        self._launch("judge")

    def _observe(self) -> None:
        observe = functools.partial(self._launch, "observe")
        if self._failures is None:
            return observe()
        run_all([observe, self._failures.find], self.device)

    def _observe_final(self) -> None:
        self._after("final")
        self._launch("final")

    def _set_values(self) -> None:
        if self.values:
            self.dyn.set(**self.values)

    def _after_reset(self) -> None:
        if self._values_later:
            self._set_values()
        if self._actuator_state is not None:
            self.dyn.reset_actuator_state(self.chosen, self._actuator_state)
        self._start_steps.run()
        self._after("observe")

    def _after(self, stage: str) -> None:
        """Compute what a stage reads of the new state."""
        kernels, frames = self._kernels[stage], self._layout.frames
        if any(kernel.reads_frames for kernel in kernels):
            self.dyn.frame_poses(self.q, frames, out=self._tensors["frame_pose"])
            self.dyn.frame_velocities(self.q, self.qd, frames, out=self._tensors["frame_velocity"])
        if any(kernel.reads_jacobians for kernel in kernels):
            self.dyn.jacobian(self.q, self._layout.jacobians, out=self._tensors["frame_jacobian"])
        if any(kernel.reads_accelerations for kernel in kernels):
            qdd, out = self._report.qdd, self._tensors["frame_acceleration"]
            self.dyn.frame_accelerations(self.q, self.qd, qdd, frames, out=out)

    def _user_parts(self, stage: str) -> list[Part]:
        """Return the parts that fill in the numbers of the user's terms in torch that a stage reads."""
        users = [(term, start) for term, (place, start) in self._layout.users.items() if place == stage]
        return [Part(functools.partial(self._fill_in, term, start), term.name) for term, start in users]

    def _fill_in(self, term: TorchTerm, start: int) -> None:
        self._tensors["user"][:, start : start + term.size].copy_(arguments.numbers_of(term, self))
