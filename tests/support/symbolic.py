"""Traces evaluated by NumPy: what an operation's kernel computes, without compiling it; and bugs planted in them."""

import gc
import inspect
import sys
import textwrap

import numpy as np

import warp_spo
from warp_spo.dynamics.stepping.midpoint_scheme import ITERATIONS
from warp_spo.execution.routine import Routine
from warp_spo.recursions import (
    composite,
    coordinates,
    determinant,
    energy,
    forward_dynamics,
    hybrid,
    kinematics,
    mass_matrix_inverse,
    momentum,
    newton_euler,
    operational,
    operators,
    quasi_velocities,
    reactions,
    regressor,
)
from warp_spo.recursions.contact import step as contact
from warp_spo.recursions.contact import velocity_kicks
from warp_spo.recursions.contact.ground import GROUND, by_cell
from warp_spo.recursions.contact.secant_laws import SECANT
from warp_spo.recursions.derivatives import adjoints, inverse_dynamics
from warp_spo.recursions.loops import closed_step, embedded, embedded_adjoints, minimal, multipliers, projection
from warp_spo.recursions.model.links import Links
from warp_spo.recursions.model.tracing import Trace
from warp_spo.recursions.step import hinge_forces, step
from warp_spo.recursions.step.step import GAIN, LOOPED, MISSED, PASS
from warp_spo.trace.evaluation import evaluate
from warp_spo.trace.scalars import ordered as ordered

TREE = (forward_dynamics, newton_euler, composite, mass_matrix_inverse, determinant, kinematics, operational, momentum,
        hybrid,
        quasi_velocities, reactions, step, hinge_forces, coordinates, operators, inverse_dynamics, adjoints, projection,
        multipliers, energy, regressor)  # fmt: skip
EMBEDDED = (minimal, embedded, embedded_adjoints)


def defined(file):
    """Functions that a module defines, by name."""
    return {name: f for name, f in vars(file).items() if getattr(f, "__module__", "") == file.__name__}


def function(operation):
    """The trace function of an operation; "embedded_..." is the one of embedded loops."""
    found = {}
    for file in TREE:
        found |= defined(file)
    for file in EMBEDDED:
        found |= {f"embedded_{name}": f for name, f in defined(file).items()}
    return found[operation]


def run(scene, operation, arrays, given, shapes, dtype="float64", **options):
    """Results by name, [world, ...] of ``shapes``, NaN where nothing is stored.

    Args:
        arrays: inputs [world, ...] by name. given: those of them that the operation gets.
    """
    stores = function(operation)(Trace(Links(scene), dtype, tuple(given)), **options)
    values = evaluate([item.value for item in stores], lambda name, at: arrays[name][(slice(None), *at)], dtype)
    results = {name: np.full((len(arrays["q"]), *shape), np.nan) for name, shape in shapes.items()}
    for item, value in zip(stores, values, strict=True):
        assert np.isnan(results[item.array][(slice(None), *item.index)]).all(), f"{item.array}{item.index} stored twice"
        results[item.array][(slice(None), *item.index)] = value
    return results


def advance(scene, arrays, h, dtype="float64", most=32, **options):
    """One step: q', qd' [world, ...] and in how many passes each world's pieces held, ``most`` + 1 if they never did.

    Args:
        arrays: q, qd and what else the step gets, [world, ...] by name.
    """
    trace = Trace(Links(scene), dtype, tuple(arrays))
    if "multipliers" in arrays:
        stores = closed_step.step_with_multipliers(trace, **options).stores
    else:
        take = closed_step.step if "embedding" in options else step.step
        stores = take(trace, **options).stores
    worlds = len(arrays["q"])
    known = arrays | {"dt": np.full((worlds, 1), h)}
    known |= {name: np.zeros((worlds, scene.dof_count)) for name in LOOPED}

    def stored(some):
        values = evaluate([item.value for item in some], lambda name, at: known[name][(slice(None), *at)], dtype)
        found = {
            name: known.get(name, np.zeros((worlds, scene.coord_count))).astype(dtype)
            for name in {item.array for item in some}
        }
        for item, value in zip(some, values, strict=True):
            found[item.array][:, item.index[0] if item.index else 0] = value
        return found

    passes, looped = np.ones(worlds, dtype=int), [item for item in stores if item.array in LOOPED]
    for number in range(most if looped else 0):
        known[PASS] = np.full((worlds, 1), float(number), dtype)
        known |= stored(looped)
        passes += known[MISSED][:, 0] > 0.0
        if not known[MISSED][:, 0].any():
            break
    known["out"] = np.zeros((worlds, scene.dof_count))
    done = stored([item for item in stores if item.array not in LOOPED])
    return done["q_out"], done["out"], passes


def contact_step(scene, arrays, h, passes=3, dtype="float64"):
    """One step with contacts: results by name, [world, ...]; arrays: q, qd and what else it gets, [world, ...]."""
    trace, worlds = Trace(Links(scene), dtype, (*arrays, "dt", "passes")), len(arrays["q"])
    phases = contact.step(trace, True, True, contact.REPORTS)
    stores = phases.stores
    known = arrays | {"dt": np.full((worlds, 1), h), "passes": np.full((worlds, 1), float(passes))}
    known |= {GAIN: np.zeros((worlds, scene.dof_count)), SECANT: np.zeros((worlds, len(phases.prologue)))}
    known[GROUND] = by_cell(scene.ground.heights).ravel() if hasattr(scene.ground, "heights") else np.zeros(0)

    def stored(some, found):
        values = evaluate([item.value for item in some], lambda name, at: known[name][(slice(None), *at)], dtype)
        for item, value in zip(some, values, strict=True):
            found[item.array][(slice(None), *item.index)] = value
        return found

    known |= stored(phases.prologue, {SECANT: known[SECANT]})
    looped = [item for item in stores if item.array in (GAIN, SECANT)]
    for number in range(passes):
        known["pass"] = np.full((worlds, 1), float(number))
        known |= stored(looped, {name: known[name].copy() for name in (GAIN, SECANT)})
    points, n = len(scene.contact_points), scene.dof_count
    shapes = {"out": (n,), "q_out": (scene.coord_count,), "qdd_out": (n,), "status": (), "contact_f": (points, 3),
              "contact_gap": (points,), "contact_slip": (points,), "contact_excess": (3,),
              "contact_moment": (points, 3)}  # fmt: skip
    last = [item for item in stores if item.array not in (GAIN, SECANT)]
    return stored(last, {name: np.full((worlds, *shape), np.nan) for name, shape in shapes.items()})


def midpoint_contact_step(scene, arrays, h, passes, dtype="float64"):
    """The same for a step that begins with rounds, whose velocity terms are kicks."""
    start = {"q": arrays["q"], "qd": arrays["qd"], "dt": np.full((len(arrays["q"]), 1), h)}
    found, kick = {"out": arrays["qd"]}, np.zeros_like(arrays["qd"])

    def computed(trace, **options):
        known = start | {
            velocity_kicks.PREVIOUS_RATES: found["out"],
            velocity_kicks.PREVIOUS_KICK: kick,
            velocity_kicks.PASS_ACCELERATION: found.get("qdd_out"),
        }
        stores = trace(Trace(Links(scene), dtype, tuple(known)), **options)
        left = {name: np.full_like(arrays["qd"], np.nan) for name in ("out", "path_out", "qdd_out")}
        left["q_out"] = np.full_like(arrays["q"], np.nan)
        read = lambda name, at: known[name][(slice(None), *at)]  # noqa: E731
        for item, value in zip(stores, evaluate([item.value for item in stores], read, dtype), strict=True):
            left[item.array][(slice(None), *item.index)] = value
        return left

    for _ in range(ITERATIONS):
        left = computed(velocity_kicks.first_kick)
        kick = left["out"]
        more = {
            "q": left["q_out"],
            velocity_kicks.START: arrays["q"],
            velocity_kicks.KICK: kick,
            velocity_kicks.PATH: left["path_out"],
        }
        found = contact_step(scene, arrays | more, h, passes, dtype)
    last = computed(velocity_kicks.final_kick, qdd=True)
    return found | {name: last[name] for name in ("out", "qdd_out")}


def plant(monkeypatch, owner, name, old, new):
    """Change ``old``, found once, to ``new`` in the source of a function or method of a module or class."""
    original = getattr(owner, name)
    source = textwrap.dedent(inspect.getsource(original))
    assert source.count(old) == 1, f"{name} holds {source.count(old)} times: {old}"
    if inspect.isclass(owner):  # compiled by itself, a method does not know its class
        source = source.replace("super()", f"super({owner.__name__}, self)")
    space = dict(original.__globals__)
    exec("from __future__ import annotations\n" + source.replace(old, new), space)
    holders = [owner]
    if inspect.ismodule(owner):  # and every module that imports the function by name
        modules = [module for key, module in sys.modules.items() if key.startswith(warp_spo.__name__)]
        holders = [module for module in modules if getattr(module, name, None) is original]
        for one in gc.get_referrers(original):  # routines, or the dictionaries of their attributes
            if type(one) is Routine or (type(one) is dict and one.get("trace") is original):
                monkeypatch.setitem(one if type(one) is dict else one.__dict__, "trace", space[name])
    for holder in holders:
        monkeypatch.setattr(holder, name, space[name])
