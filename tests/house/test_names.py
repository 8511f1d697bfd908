"""Names of files and users: none reaches generated code, and messages show them escaped."""

import contextlib
import dataclasses
import re
from contextlib import contextmanager
from unittest import mock

import numpy as np
import pytest

import warp_spo as spo
from support.env_scenes import walker_q, walker_scene
from warp_spo.env import Env, Observation, TorchTerm, actions, commands, events, observations, terminations
from warp_spo.env.compile.vectors import vector
from warp_spo.errors import shown
from warp_spo.examples import fourbar
from warp_spo.kernels import native
from warp_spo.newton import load
from warp_spo.runtime import launches

CONTROL = [chr(code) for code in range(0xA0)]  # U+0000 to U+009F
LINE_ENDS = ["\x85", "\u2028", "\u2029", "\r\n"]
QUOTES = ['"""', "'''", "//", "/*", "*/", "\\", "\\\n", "??/", "%s", "{0}", "{thread}", "|", "\u202e", "é", "漢"]
LONE = ["\ud800", "\udfff"]
LONG = "x" * 200_000
INJECTED = '"); printf("run"); //\n}; printf("run");\\'
HOSTILE = [*CONTROL, *LINE_ENDS, *QUOTES, *LONE, LONG, INJECTED]
TOGETHER = "".join([*CONTROL, *LINE_ENDS, *QUOTES, *LONE, INJECTED])
CALLS = ("forward_dynamics", "body_poses", "mass_matrix")
FRAMED = (
    *("frame_poses", "frame_velocities", "frame_accelerations", "jacobian", "jacobian_bias"),
    *("operational_inertia_inverse", "operational_inertia", "inverse_kinematics"),
)


def scene(name):
    """Return a walker in which all that has a name is called ``name``, then a number."""
    plain, count = walker_scene(), iter(range(10_000))
    bodies, hinges, motors, contacts = (
        [dataclasses.replace(part, label=f"{next(count)}{name}{next(count)}{name}") for part in parts]
        for parts in (plain.bodies, plain.hinges, plain.actuators, plain.contacts)
    )
    sites, key = {f"at{name}": (2, (0.1, 0, 0, 0, 0, 0, 1))}, spo.Keyframe(walker_q(), np.zeros(14), np.zeros(8))
    return spo.Scene(bodies, hinges, actuators=motors, contacts=contacts, sites=sites, keyframes={name: key})


def geared(name):
    """Return a pendulum with a gear in which all that has a name is called ``name``."""
    hinges = [spo.Hinge("revolute", i - 1, i, axis=(0, 1, 0), rotor=spo.Rotor(1e-4, 20.0), label=name) for i in (0, 1)]
    return spo.Scene([spo.Body(1.0, (0, 0, 0.1), np.eye(3), label=name) for _ in hinges], hinges)


def linkage(name):
    """Return a four-bar linkage in which all that has a name is called ``name``."""
    plain = fourbar.scene()
    bodies, hinges, loops = (
        [dataclasses.replace(part, label=name) for part in parts] for parts in (plain.bodies, plain.hinges, plain.loops)
    )
    return spo.Scene(bodies, hinges, loops=loops, couplings=plain.couplings)


def mimic(name):
    """Return two hinges of which one follows the other, and in which all that has a name is called ``name``."""
    hinges = [spo.Hinge("revolute", i - 1, i, axis=(0, 1, 0), label=f"{i}{name}") for i in (0, 1)]
    bodies = [spo.Body(1.0, (0, 0, 0.1), np.eye(3), label=f"{i}{name}") for i in (0, 1)]
    return spo.Scene(bodies, hinges, couplings=[spo.Coupling(1, 0, 0.5, 0.1)])


@contextmanager
def recorded(runs=True):
    """Yield a list that receives all that kernels are made of; if not ``runs``, nothing is compiled and launched."""
    found, kernel = [], native.kernel

    def record(*parts, **more):
        found.append((parts, more))
        return kernel(*parts, **more) if runs else None

    launch = contextlib.nullcontext() if runs else mock.patch.object(launches, "launch")
    with mock.patch.object(native, "kernel", record), launch:
        yield found


def texts(scene, granularity, calls=CALLS, frames=None, **options):
    """Return all that the kernels of some calls are made of; ``frames`` are the names that calls in frames take."""
    with recorded(runs=False) as found:
        dyn = spo.Dynamics(scene, 2, "cpu", granularity=granularity, **options)
        for call in calls:
            dyn.prepare(call)
        for call in FRAMED if frames else ():
            dyn.prepare(call, frames=frames)
        if not scene.loops and not scene.couplings:
            operators = dyn.operators(np.zeros((2, scene.coord_count)))
            (operators.phi @ operators.M).apply(np.ones((2, operators.M.shape[1])))
    return found


@pytest.mark.parametrize(
    "make, granularity, options",
    [
        (scene, "tree", {}),
        (scene, "segment", {}),
        (scene, "node", {}),
        (geared, "tree", {}),
        (linkage, "tree", {"loops": "embed"}),
        (linkage, "node", {"loops": "multipliers"}),
        (mimic, "tree", {"loops": "embed"}),
        (mimic, "tree", {"loops": "multipliers"}),
    ],
)
def test_kernels_of_scenes_do_not_know_names(make, options, granularity):
    plain = texts(make("part"), granularity, **options)
    assert (plain or granularity == "node") and all(str(parts).isascii() for parts in plain)
    assert texts(make(TOGETHER), granularity, **options) == plain
    if make is geared:
        plain = texts(make("part"), granularity, CALLS[:1])
        for name in HOSTILE:
            assert texts(make(name), granularity, CALLS[:1]) == plain, shown(name)


@pytest.mark.parametrize("granularity", ["tree", "segment", "node"])
def test_kernels_of_frames_do_not_know_names(granularity):
    def frames(name):
        own = scene(name)
        site, label = f"at{name}", own.body_labels[4]
        return texts(own, granularity, calls=(), frames=[site, label, (label, (0.1, 0, 0, 0, 0, 0, 1))])

    plain = frames("part")
    assert all(str(parts).isascii() for parts in plain) and (plain or granularity == "node")
    for name in (TOGETHER, LONG) if granularity == "tree" else [TOGETHER]:
        assert frames(name) == plain, shown(name)


def states(scene, granularity):
    """Return results of a call and a step in several worlds."""
    dyn, rng = spo.Dynamics(scene, 3, "cpu", granularity=granularity), np.random.default_rng(3)
    q, qd = np.tile(walker_q(), (3, 1)), rng.normal(size=(3, scene.dof_count))
    return [dyn.forward_dynamics(q, qd, qd), *(dyn.step(q, qd, qd, 1e-3) if granularity != "node" else ())]


@pytest.mark.parametrize("granularity", ["segment", "node"])
def test_results_do_not_know_names(granularity):
    with recorded() as plain:
        expected = states(scene("part"), granularity)
    with recorded() as hostile:
        found = states(scene(TOGETHER), granularity)
    assert hostile == plain
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def named(name, function):
    function.__name__ = name
    return function


class Asked(commands.Velocity):
    """A command that remembers something by a name, and whose ranges grow with a reward of that name."""

    def __init__(self, name):
        super().__init__(heading=(-1.0, 1.0), level=commands.Level(name), seconds=(0.02, 0.02))
        object.__setattr__(self, "name", name)

    def draw(self, w, done):
        return super().draw(w, done) | {f"asked {self.name}": vector([w.uniform(0.0, 1.0)])}

    def update(self, w, command):
        (more,) = w.memory(f"asked {self.name}", 1, reset=None)
        return super().update(w, command) + more


def environment(name):
    """Return an environment in which all that has a name is called ``name``, and what two steps of it give."""
    own = scene(name)
    env = Env(
        own,
        2,
        "cpu",
        default_q=walker_q(),
        actions=actions.Control(scale=0.5),
        observations={
            name: [
                Observation(named(name, lambda w: w.qd), noise=0.1, history=2),
                lambda w: w.memory(name, 1) + w.frame(f"at{name}").position[2],
                Observation(lambda w: w.table(name, np.arange(4.0).reshape(2, 2))(0)),
                TorchTerm(lambda env: env.q[:, :1], 1, name=name),
                lambda w: w.imu(f"at{name}").acceleration,
                lambda w: w.drawn(f"drawn {name}", 1, lambda w: [w.uniform(0.0, 1.0)]),
                lambda w: w.sensor(f"kept {name}", 1, lambda w: w.keep(f"kept {name}", [w.q[2]])),
                lambda w: w.feet(re.escape(own.body_labels[2])).force,
                lambda w: w.joint_q(re.escape(own.joint_labels[3])),
                observations.command,
            ]
        },
        commands=Asked(name),
        rewards={name: (1.0, lambda w: -(w.qd[0] ** 2))},
        terminations={name: terminations.tilted(1.0)},
        events=[
            events.joints((-0.1, 0.1), (-0.2, 0.2), re.escape(own.joint_labels[2])),
            events.randomise("body_mass", (0.9, 1.1), names=re.escape(own.body_labels[1])),
        ],
        episode_length_s=0.1,
    )
    rows = []
    for _ in range(3):
        observed, reward, done, _ = env.step(np.full((2, env.num_actions), 0.3, dtype=np.float32))
        rows += [observed[name], reward, done]
    return env, rows


def test_kernels_of_environments_do_not_know_names():
    with recorded() as plain:
        expected = environment("part")[1]
    for name in (TOGETHER, LONG):
        with recorded() as hostile:
            env, found = environment(name)
        assert hostile and all(kernel in plain for kernel in hostile)  # one that copies rows is there already
        assert all(one.equal(other) for one, other in zip(found, expected, strict=True))
        assert all(line.isprintable() for line in env.explain().split("\n"))


ARGUMENTS = dict(scene=scene(TOGETHER), worlds=1, device="cpu", default_q=walker_q(), actions=actions.Control()) | dict(
    observations={"actor": [lambda w: w.q]}
)


def test_messages_show_names_escaped():
    loop = linkage(TOGETHER)
    walker = scene(TOGETHER)
    for call in (
        lambda: spo.Dynamics(loop, 1, "cpu").forward_dynamics(*np.zeros((3, 1, loop.dof_count))),
        lambda: spo.Dynamics(walker, 1, "cpu").frame_poses(walker_q()[None], frames=["at"]),
        lambda: spo.Dynamics(walker, 1, "cpu").frame_poses(walker_q()[None], frames=[TOGETHER]),
        lambda: spo.Dynamics(walker, 1, "cpu").frame_poses(walker_q()[None], frames=[(f"at{TOGETHER}", "pose")]),
        lambda: spo.Dynamics(mimic(TOGETHER), 1, "cpu").forward_dynamics(*np.zeros((3, 1, 2))),
        lambda: spo.Dynamics(mimic(TOGETHER), 1, "cpu", loops="embed", independent=["none"]),
        lambda: spo.Scene(loop.bodies, loop.hinges, couplings=[spo.Coupling(0, 0)]),
        lambda: Env(**ARGUMENTS, commands=commands.Uniform(((0, 1),)), rewards={TOGETHER: (1.0, lambda w: w.q)}),
        lambda: Env(**ARGUMENTS, commands=Asked(TOGETHER), rewards={f"my {TOGETHER}": (1.0, lambda w: w.q[0])}),
        lambda: Env(**ARGUMENTS, rewards={"one": (1.0, lambda w: w.frame(TOGETHER).position[0])}),
        lambda: Env(**ARGUMENTS, rewards={"one": (1.0, lambda w: w.joint_q(re.escape(TOGETHER))[0])}),
        lambda: spo.Dynamics(loop, 1, "cpu", loops="embed", independent=["none"]),
        lambda: environment(TOGETHER)[0].step(np.zeros((1, 1), dtype=np.float32)),
        lambda: spo.Body(-1.0, label=TOGETHER),
        lambda: spo.Hinge("revolute", -1, 0, axis=(0, 0, 0), label=TOGETHER),
        lambda: spo.Scene([spo.Body(1.0, label=TOGETHER)] * 2, [spo.Hinge("free", -1, 0, label=TOGETHER)]),
    ):
        with pytest.raises((ValueError, TypeError)) as error:
            call()
        assert str(error.value).isprintable(), str(error.value)[:200]


URDF = """<robot name="{0}"><link name="{0}base"/><link name="{0}arm"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{0}turn" type="continuous"><parent link="{0}base"/><child link="{0}arm"/>
<axis xyz="0 0 1"/></joint><link name="{0}hand"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="{0}follower" type="continuous">
<parent link="{0}arm"/><child link="{0}hand"/><axis xyz="0 0 1"/>
<mimic joint="{0}turn" multiplier="2"/></joint></robot>"""
MJCF = """<mujoco model="{0}"><worldbody><body name="{0}arm"><joint name="{0}turn" axis="0 0 1"/>
<geom name="{0}ball" size=".1" mass="1"/><site name="{0}at"/></body>
<body name="{0}other"><joint name="{0}follower" axis="0 0 1"/><geom size=".1" mass="1"/></body></worldbody>
<equality><joint name="{0}mimic" joint1="{0}follower" joint2="{0}turn" polycoef="0 2 0 0 0"/></equality>
<keyframe><key name="{0}key" qpos="0 0"/></keyframe>
<actuator><motor name="{0}" joint="{0}turn"/></actuator></mujoco>"""
IN_FILES = "&#10;printf(&quot;run&quot;);&#13;&#9;//\\?é{x}%s*/'&#x2028;"


@pytest.mark.parametrize("suffix, text", [(".urdf", URDF), (".xml", MJCF)])
def test_names_of_files(suffix, text, tmp_path):
    found = []
    for number, name in enumerate(["part", IN_FILES]):
        path = tmp_path / f"robot{number}{suffix}"
        path.write_text(text.replace("{0}", name), encoding="utf-8")
        own = load(path)
        assert len(own.couplings) == 1
        frames = [own.body_labels[-1], *own.sites]
        found.append(
            texts(own.without_loops(), "tree", frames=frames[:1] + frames[-1:]) + texts(own, "tree", loops="embed")
        )
    assert found[0] == found[1]
