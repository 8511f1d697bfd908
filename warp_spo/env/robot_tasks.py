"""Files of tasks for a robot of one's own: ``python -m warp_spo.tasks --new FILE.py --robot ROBOT.xml``."""

from __future__ import annotations

import json
import os
import re
import textwrap
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import shown
from ..scene.collision_shapes import floating_bases, moving_trees
from ..scene.parts import UNLIMITED

WIDTH = 114  # of lines of the file


def robot_task(file: Path, robot: Path) -> str:
    """Return the text of a task's file for the robot of an MJCF file.

    A robot that floats stands and follows velocities, one on a fixed base holds the pose from which episodes start.
    Actions, observations, ends and events follow from the robot's joints and actuators.

    Args:
        file: that the text is for. robot: MJCF file.

    Raises:
        ValueError: the robot's file is no MJCF, or cannot be read, or holds nothing that moves. OSError: there is none.
    """
    if robot.suffix.lower() not in (".xml", ".mjcf"):
        raise ValueError(
            f"--robot {str(robot)!r}: expected an MJCF file, .xml; a URDF says neither gains nor motors: the page on "
            "training has the way from one"
        )
    from .. import load

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # which the task says when it is trained
        scene = load(robot, contacts="ground")
    reads = 'contacts="ground"' if scene.contacts else ""
    trees = moving_trees(scene)
    if len(trees) > 1:
        reads = "contacts=True"  # a robot and what it handles: bodies touch each other, too
    single = [i for i, hinge in enumerate(scene.hinges) if hinge.coord_count == hinge.dof_count == 1]
    if not single:
        raise ValueError(f"--robot {str(robot)!r}: has no joint of one coordinate; expected one or more to act on")
    bases = floating_bases(scene)
    floats = bool(bases) and len(trees[scene.hinges[bases[0]].child]) > 1  # a free body alone is an object
    if floats and not reads:
        reads = 'contacts="*"'  # of a file without a floor: all shapes, on the plane z = 0
    endless = _endless(scene, single)
    name = os.path.relpath(robot.resolve(), file.resolve().parent)
    return "\n".join([
        _head(shown(robot.stem), name, file, floats),
        _start(scene, scene.initial_q),
        *([] if floats or not endless else [_angles(endless)]),
        _build(scene, single, endless, floats, reads),
    ])  # fmt: skip


def _endless(scene: Any, single: list[int]) -> list[str]:
    """Return the labels of the joints that turn without limits."""
    bounds = [abs(scene.values[f"joint_limit_{end}"][0]) for end in ("lower", "upper")]
    free = np.minimum(*bounds) >= UNLIMITED
    turns = [i for i in single if scene.hinges[i].kind == "revolute" and free[scene.qd_start[i]]]
    return [scene.joint_labels[i] for i in turns]


def _names(labels: list[str]) -> str:
    """Return labels as the regular expressions that match them alone, in Python's words."""
    texts = [json.dumps(re.escape(label).replace("\\ ", " ")) for label in labels]
    return texts[0] if len(texts) == 1 else f"({', '.join(texts)})"


def _head(robot: str, path: str, file: Path, floats: bool) -> str:
    about = "follows velocities" if floats else "holds the pose from which it starts"
    parts = ("Observation", "actions", *["commands"] * floats, "events", "observations", "rewards")
    parts += ("terminations",) * floats
    return f'''\
# A task of your own, made for {path}. It trains as it is; what the robot shall do is yours to say, in rewards.
#   python -m warp_spo.train {file}                           trains it, into runs/{file.stem}
#   python -m warp_spo.play {file} runs/{file.stem}/last.pt --export {file.stem} --film gif
"""{robot} {about}."""

from pathlib import Path

import numpy as np

import warp_spo as spo
from warp_spo.env import {", ".join(parts)}
from warp_spo.env.learning import Learner
from warp_spo.env.settings import make_env

ROBOT = {json.dumps(path)}  # from this file's folder; films and pages draw it, and play --mujoco runs it
# Settings of PPO: --set learner.NAME=VALUE changes one for a training. On a GPU take 4096 worlds.
LEARNER = Learner(iterations=300, worlds=512, steps=24, hidden=(128, 64))'''


def _start(scene: Any, start: np.ndarray) -> str:
    if scene.keyframes:
        names = list(map(json.dumps, scene.keyframes))
        return f"# Where episodes start: the name of a keyframe of the file, {', '.join(names)}.\nSTART = {names[0]}"
    alone = scene.hinges[0].coord_count == 7 and len(moving_trees(scene)) == 1
    order = "x, y, z, quaternion xyzw, joints" if alone else "in the order of q"
    lines = textwrap.wrap(", ".join(map(_text, start)), WIDTH - 4)
    text = lines[0] if len(lines) == 1 else "\n    " + "\n    ".join(lines) + "\n"
    return f"# Where episodes start, and the file stands: {order}.\nSTART = [{text}]"


def _angles(endless: list[str]) -> str:
    return f'''\
ENDLESS = {_names(endless)}  # joints that turn without limits


def angles(w):
    """Return sine and cosine of these joints, which are alike after each turn."""
    return [function(angle) for angle in w.joint_q(ENDLESS) for function in (np.sin, np.cos)]'''


def _action(scene: Any) -> tuple[str, str]:
    """Return the text of the actions, and what they are in words."""
    if not scene.actuators:
        return "actions.Effort(scale=1.0, clip=(-1.0, 1.0))", "forces of joints [N m or N]: the file has no actuators"
    servos = [each.gain > 0.0 and each.bias[1] == -each.gain and len(each.hinges) == 1 for each in scene.actuators]
    if all(servos):
        scale = np.array([_stroke(scene, each.hinges[0]) for each in scene.actuators])
        text = f'actions.Control(scale={_number(scale)}, offset="default")'
        return text, "targets of the file's servos, about START [rad or m]"
    ranges = np.array([each.ctrl_range for each in scene.actuators])
    ranges = np.where(np.isfinite(ranges).all(axis=1, keepdims=True), ranges, (-1.0, 1.0))
    middle, half = ranges.mean(axis=1), 0.5 * np.ptp(ranges, axis=1)
    given = [f"{name}={_number(each)}" for name, each in (("scale", half), ("offset", middle)) if each.any()]
    return f"actions.Control({', '.join([*given, 'clip=(-1.0, 1.0)'])})", "controls of the file's actuators"


def _stroke(scene: Any, hinge: int) -> float:
    """Return how far an action of one moves the target of a joint: half the range of a slide, at most 0.3."""
    dof = scene.qd_start[hinge]
    low, high = (float(scene.values[f"joint_limit_{end}"][0, dof]) for end in ("lower", "upper"))
    slides = scene.hinges[hinge].kind == "prismatic" and high - low < UNLIMITED
    return min(0.3, 0.5 * (high - low)) if slides and high > low else 0.3


def _number(values: np.ndarray) -> str:
    """Return one number where all are alike, otherwise a list."""
    return _text(values[0]) if np.ptp(values) == 0.0 else f"[{', '.join(map(_text, values))}]"


def _text(x: float) -> str:
    return repr(float(f"{x:.6g}"))


def _spreads(scene: Any, single: list[int], limited: list[str]) -> list[str]:
    """Return the events that change where joints start: by 0.05 rad or m, or less in a short slide."""
    names: dict[float, list[str]] = {}
    for i in single:
        if scene.joint_labels[i] in limited:
            names.setdefault(round(min(0.05, _stroke(scene, i) / 6.0), 4), []).append(scene.joint_labels[i])
    every = len(names) == 1 and len(limited) == len(single)
    return [
        f"events.joints(position=({-most:g}, {most:g}){'' if every else f', names={_names(each)}'})"
        for most, each in names.items()
    ]


def _start_height(scene: Any) -> float:
    """Return the height of the base of a robot that floats, where episodes start [m]."""
    first = next(iter(scene.keyframes.values())).q if scene.keyframes else scene.initial_q
    return float(first[2])


def _build(scene: Any, single: list[int], endless: list[str], floats: bool, reads: str) -> str:
    action, meaning = _action(scene)
    limited = [label for i in single if (label := scene.joint_labels[i]) not in endless]
    seen = ["observations.base_velocity", "observations.base_angular_velocity", "observations.projected_gravity"]
    seen = seen if floats else []
    if limited:
        seen.append(f"observations.joint_position({_names(limited) if endless else ''})")
    seen += [] if floats or not endless else ["angles"]  # the angle of a wheel says nothing
    seen += ["Observation(observations.joint_velocity(), scale=0.1)", "observations.last_action"]
    seen += ["observations.command"] if floats else []
    changes = _spreads(scene, single, limited)
    if floats:
        goal = """\
            "alive": (1.0, rewards.alive),
            "velocity": (2.0, rewards.track_velocity(0.5)),
            "turning": (1.0, rewards.track_turning(0.5)),
            "tilt": (-2.0, rewards.tilt),"""
        changes = ["events.base(yaw=(-np.pi, np.pi), pitch=(-0.05, 0.05))", *changes, "events.push(velocity=0.3)"]
        more = """
        commands=commands.Velocity(forward=(-0.5, 0.5), left=(0.0, 0.0), turn=(-1.0, 1.0), seconds=(3.0, 8.0)),
        terminations={"""
        low = round(0.5 * _start_height(scene), 3)
        ends = ['"fell over": terminations.tilted(np.radians(60.0))']
        ends += [f'"lies": terminations.below({low})'] if low > 0.0 else []  # or it learns to lie down
        more += ", ".join(ends) + "},"
    else:
        goal, more = '            "pose": (1.0, rewards.posture(0.3)),', ""
    rows = lambda parts: "\n".join(f"            {part}," for part in parts)  # noqa: E731
    pose = "scene.keyframes[START].q" if scene.keyframes else "START"
    loops = ".without_loops()" if scene.constraint_summary else ""
    return f'''

def build(worlds, device=None, seed=0, **options):
    """Return the environment; what make_env gets by name, --set changes."""
    scene = spo.load(Path(__file__).parent / ROBOT{reads and f", {reads}"}){loops}
    return make_env(
        scene, worlds, device, options, seed=seed, dt=5e-3, decimation=4, default_q={pose},
        episode_length_s=10.0,
        actions={action},  # {meaning}{more}
        observations={{"actor": [
{rows(seen)}
        ]}},
        rewards={{  # by name (weight, term); a term is a function of one world, such as lambda w: w.base_height
{goal}
            "action rate": (-0.01, rewards.action_rate),
        }},
        events=[
{rows(changes)}
        ],
    )  # fmt: skip
'''
