"""Names of files and users: none reaches generated code, and messages show them escaped."""

import contextlib
import dataclasses
from contextlib import contextmanager
from unittest import mock

import numpy as np
import pytest

import warp_spo as spo
from support.env_scenes import walker_q, walker_scene
from warp_spo.env import Env, Observation, TorchTerm, actions, events, terminations
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


def texts(scene, granularity, calls=CALLS, **options):
    """Return all that the kernels of some calls are made of."""
    with recorded(runs=False) as found:
        dyn = spo.Dynamics(scene, 2, "cpu", granularity=granularity, **options)
        for call in calls:
            dyn.prepare(call)
        if not scene.loops:
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
    ],
)
def test_kernels_of_scenes_do_not_know_names(make, options, granularity):
    plain = texts(make("part"), granularity, **options)
    assert (plain or granularity == "node") and all(str(parts).isascii() for parts in plain)
    for name in HOSTILE if make is geared else [TOGETHER]:
        assert texts(make(name), granularity, **options) == plain, shown(name)


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
            ]
        },
        rewards={name: (1.0, lambda w: -(w.qd[0] ** 2))},
        terminations={name: terminations.tilted(1.0)},
        events=[events.joints((-0.1, 0.1), (-0.2, 0.2)), events.randomise("body_mass", (0.9, 1.1))],
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


def test_messages_show_names_escaped():
    loop = linkage(TOGETHER)
    walker = scene(TOGETHER)
    for call in (
        lambda: spo.Dynamics(loop, 1, "cpu").forward_dynamics(*np.zeros((3, 1, loop.dof_count))),
        lambda: spo.Dynamics(walker, 1, "cpu").frame_poses(walker_q()[None], frames=["at"]),
        lambda: spo.Dynamics(loop, 1, "cpu", loops="embed", independent=["none"]),
        lambda: environment(TOGETHER)[0].step(np.zeros((1, 1), dtype=np.float32)),
        lambda: spo.Body(-1.0, label=TOGETHER),
        lambda: spo.Hinge("revolute", -1, 0, axis=(0, 0, 0), label=TOGETHER),
        lambda: spo.Scene([spo.Body(1.0, label=TOGETHER)] * 2, [spo.Hinge("free", -1, 0, label=TOGETHER)]),
    ):
        with pytest.raises(ValueError) as error:
            call()
        assert str(error.value).isprintable(), str(error.value)[:200]


URDF = """<robot name="{0}"><link name="{0}base"/><link name="{0}arm"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{0}turn" type="continuous"><parent link="{0}base"/><child link="{0}arm"/>
<axis xyz="0 0 1"/></joint></robot>"""
MJCF = """<mujoco model="{0}"><worldbody><body name="{0}arm"><joint name="{0}turn" axis="0 0 1"/>
<geom name="{0}ball" size=".1" mass="1"/></body></worldbody>
<actuator><motor name="{0}" joint="{0}turn"/></actuator></mujoco>"""
IN_FILES = "&#10;printf(&quot;run&quot;);&#13;&#9;//\\?é{x}%s*/'&#x2028;"


@pytest.mark.parametrize("suffix, text", [(".urdf", URDF), (".xml", MJCF)])
def test_names_of_files(suffix, text, tmp_path):
    found = []
    for number, name in enumerate(["part", IN_FILES]):
        path = tmp_path / f"robot{number}{suffix}"
        path.write_text(text.replace("{0}", name), encoding="utf-8")
        found.append(texts(load(path), "tree"))
    assert found[0] == found[1]
