"""Environments for reinforcement learning: thousands of worlds, and a step that is one CUDA graph.

::

    env = Env(
        scene, worlds=4096, device="cuda:0", dt=5e-3, decimation=4,
        actions=actions.Effort("slide", scale=10.0),
        observations={"actor": [lambda w: w.q, Observation(lambda w: w.qd, noise=0.1)]},
        rewards={"up": (1.0, lambda w: np.cos(w.q[1]))},                          # weight, term
        terminations={"out": lambda w: abs(w.q[0]) > 2.4},
        events=[events.joints(position=(-0.1, 0.1))],
        episode_length_s=10.0,
    )
    observed, rewards, dones, extras = env.step(actions)                          # an rsl_rl VecEnv

**A term is a function of one world**, ``World``, whose attributes are abstract scalars and NumPy arrays of them:
``w.q``, ``w.joint_q("hip.*")``, ``w.base_velocity``, ``w.command``, ``w.contact_force``,
``w.feet("calf.*").air_time``, ``w.frame("hand").position``. It is traced once, when the environment is made, like the
pose of a custom hinge: written with arithmetic, comparisons and NumPy's functions, with ``spo.where`` and ``spo.clip``
in place of branches. All terms of a stage become one kernel. Ready terms are in :mod:`.observations`, :mod:`.rewards`
and :mod:`.terminations`.

**What a step does**, arrays [world, ...], kernels in capitals::

    actions ──ACT──> ctrl, target_q or tau                       scale, offset, clip; action history
            dyn.step ──> q, qd, contact_f, contact_gap, contact_slip
            JUDGE: q, qd, contacts, memory ──> reward, done, time_out; and in worlds that are done new q, qd, gaps;
                   commands, pushes, timers, sums of episodes, air times
            dyn.reset_actuator_state(done)
            OBSERVE: q, qd, command, memory ──> a row of each group, with noise

``memory`` [number, world] holds all that a world remembers from step to step: actions, commands, timers, air times,
sums. A term may have its own: ``w.memory(name, size)`` reads it, ``w.keep(name, values)`` changes it, and a reset
clears it. Random numbers are Philox 4x32-10 of (seed; number of the world in the whole run, step of the world, stage,
number of the draw), so that a world's course depends neither on the device nor on the other worlds.

A world whose actions, state, observations or rewards are not finite, or beyond :class:`Bounds`, starts anew, ends with
``terminated``, reward 0, and is counted by its first cause; see ``env.log()``. No such number leaves the environment.
Other worlds do not notice.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from . import actions, commands, curricula, events, observations, rewards, terminations
from .bounds import Bounds
from .observations import Observation, TorchTerm
from .world import World

if TYPE_CHECKING:
    from .environment import Env

__all__ = [
    "Bounds",
    "Env",
    "Observation",
    "TorchTerm",
    "World",
    "actions",
    "commands",
    "curricula",
    "events",
    "gymnasium",
    "make",
    "observations",
    "rewards",
    "skrl",
    "terminations",
]


def gymnasium(env: Env, tensors: bool = False, single: bool = False, autoreset_mode: Any = "SameStep") -> Any:
    """Return an environment as a ``gymnasium.vector.VectorEnv``.

    Observations are NumPy arrays [world, number], or a dictionary of them if there are several groups. Actions are
    unbounded; their space says -1 to 1, from which random ones are drawn.

    Args:
        env: the environment. With ``final_observations=True`` the information holds "final_obs" in the mode "SameStep";
            other modes need it.
        tensors: whether observations, rewards, ends and information are torch tensors on the environment's device.
        single: return a ``gymnasium.Env`` of the one world of ``env`` instead, with NumPy arrays. After the end of an
            episode a step is a RuntimeError until ``reset``. It needs ``final_observations=True``.
        autoreset_mode: a ``gymnasium.vector.AutoresetMode`` or its value. "SameStep": a world starts anew in the step
            that ends its episode. "NextStep": in the step after it, which ignores its action and has reward 0.
            "Disabled": in ``reset(options={"reset_mask": ...})``, before the next step. Episodes are the same in all.

    Raises:
        ValueError: the mode is none, or needs ``final_observations=True``; single=True with several worlds, without
            ``final_observations=True``, or with ``tensors`` or a mode.
    """
    from .interfaces import make_single, make_vector

    return make_single(env, tensors, autoreset_mode) if single else make_vector(env, tensors, autoreset_mode)


def skrl(env: Env, observations: str | None = None, states: str | None = None) -> Any:
    """Return an environment as a wrapper of skrl.

    Args:
        env: the environment.
        observations: the group that the policy sees; None: the first.
        states: the group that the critic sees; None: the second, if there is one and ``observations`` is None, too;
            otherwise the critic gets no states of its own.
    """
    from .interfaces import make_skrl

    return make_skrl(env, observations, states)


def __getattr__(name: str) -> Any:
    """Return ``Env``, which imports torch; robots and terms alone do not."""
    if name == "Env":
        from .environment import Env

        return Env
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def make(name: str, worlds: int | None = None, device: Any = None, seed: int = 0, **options: Any) -> Env:
    """Return the environment of a task; nothing is downloaded.

    Args:
        name: "cartpole", "ant", "panda-reach", "go2-flat", "go2-rough" or "g1-flat"; or of a task of your own: FILE.py,
            package.module, or a name that a package registers ("python -m warp_spo.tasks" lists them).
        worlds: how many; None: as many as the task is trained with.
        device: Warp or torch device. seed: of all random numbers. options: arguments of ``Env`` that the task leaves
            open, such as ``first_world`` and ``final_observations``.

    Raises:
        ValueError: there is no task of this name.
        TypeError: an option is one that the task sets itself, such as ``dt``, or that ``Env`` does not have.
    """
    from .tasks import check_options, task

    chosen = task(name)
    check_options(name, options)
    return chosen.build(chosen.LEARNER.worlds if worlds is None else worlds, device, seed, **options)
