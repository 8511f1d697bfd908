"""Gradients of steps with contacts, and of what they are compared with: central differences away from switches.

Traces are evaluated by NumPy, the moved copies of all worlds at once; so are the answers of all their comparisons, by
which a difference across a switch is known and left out.
"""

import numpy as np

from warp_spo.recursions.contact import step as contact_step
from warp_spo.recursions.contact.ground import CORNERS, GROUND, by_cell, corner_steps
from warp_spo.recursions.contact.points import surface_numbers
from warp_spo.recursions.contact.secant_laws import SECANT
from warp_spo.recursions.derivatives import contact as contact_derivatives
from warp_spo.recursions.derivatives import contact_pass
from warp_spo.recursions.model.links import Links
from warp_spo.recursions.model.messages import SIZES
from warp_spo.recursions.model.tracing import Trace
from warp_spo.recursions.step.step import GAIN
from warp_spo.scene.contact_values import TURNING_VALUES
from warp_spo.trace.evaluation import evaluate
from warp_spo.trace.scalars import ordered

HEIGHTS = "ground_heights"
VALUES = ("contact_friction", "contact_stiffness", "contact_damping", "joint_target_ke", "joint_target_kd",
          "ground_origin", HEIGHTS)  # fmt: skip
STEP = {"q": 1e-6, "qd": 1e-6, "tau": 1e-3, "body_f": 1e-3, "target_q": 1e-4, "target_qd": 1e-4, "ctrl": 1e-4,
        "ground_origin": 1e-6, HEIGHTS: 1e-6}  # fmt: skip
"""Of the differences; values move by RELATIVE of themselves. Smaller ones drown in rounding errors."""
RELATIVE = 3e-3
OTHERS = 4  # heights of a field that no point stands on, whose differences are taken
FOURTH = ((1.0, 8.0), (-1.0, -8.0), (2.0, -1.0), (-2.0, 1.0))
"""How far each copy moves, and its weight in twelve steps of the difference, which is of fourth order."""


def variable(scene):
    """Names of the values by which there are gradients: of torsional and rolling friction where the scene has some."""
    return (*VALUES, *(name for name in TURNING_VALUES if scene.values[name].any()))


def furnish(scene, a):
    """The arguments and the values of a scene by name, [world, ...]."""
    worlds = len(a["q"])
    values = {name: scene.values[name] for name in variable(scene) if scene.values[name].size}
    return a | {name: np.tile(value, (worlds, *[1] * (value.ndim - 1))) for name, value in values.items()}


def trace_of(scene, names):
    return Trace(Links(scene, variable(scene)), "float64", names)


def store(stores, known, found):
    """Evaluate stores into arrays by name; return the answers of all comparisons [world, comparison]."""
    outputs = [item.value for item in stores]
    asked = [x for x in ordered(outputs) if x.op in ("less", "floor", "search")]
    values = evaluate([*outputs, *asked], lambda name, at: known[name][(slice(None), *at)], "float64")
    for item, value in zip(stores, values, strict=False):
        found[item.array][(slice(None), *item.index)] = value
    worlds = len(known["q"])
    answers = [np.broadcast_to(value, worlds) for value in values[len(outputs) :]]
    return np.array([discrete(x) if of.op == "search" else x for of, x in zip(asked, answers, strict=True)]).T


def discrete(values):
    """Numbers that a search finds: of a place in a cell, which follows the pose smoothly, whether it is at an end."""
    return np.where(values == np.round(values), values, 0.5 * np.sign(values))


def cells_of(known):
    """The table of cells [world, entry]: each world has its own here."""
    return by_cell(known[HEIGHTS]).reshape(len(known["q"]), -1) if HEIGHTS in known else np.zeros((len(known["q"]), 0))


def step(scene, a, h, passes):
    """q', qd' [world, ...] and the answers of all comparisons on the way [world, comparison]."""
    arguments = tuple(name for name in a if name not in (*VALUES, *TURNING_VALUES))
    trace, worlds = trace_of(scene, (*arguments, "dt", "passes")), len(a["q"])
    phases = contact_step.step(trace)
    stores = phases.stores
    known = a | {"dt": np.full((worlds, 1), h), "passes": np.full((worlds, 1), float(passes))}
    known |= {GAIN: np.zeros((worlds, scene.dof_count)), SECANT: np.zeros((worlds, len(phases.prologue)))}
    known[GROUND] = cells_of(known)
    answers = [store(phases.prologue, known, known)]
    looped = [item for item in stores if item.array in (GAIN, SECANT)]
    for number in range(passes):
        known["pass"] = np.full((worlds, 1), float(number))
        after = {name: known[name].copy() for name in (GAIN, SECANT)}
        answers.append(store(looped, known, after))
        known |= after
    found = {"q_out": np.full((worlds, scene.coord_count), np.nan), "out": np.full((worlds, scene.dof_count), np.nan)}
    store([item for item in stores if item.array in found], known, found)
    return found["q_out"], found["out"], np.concatenate(answers, axis=1)


def gradient(scene, a, h, passes, cotangents, wrt, ran=None):
    """The gradients of the sum of cotangents times results by name, from the kernels' traces.

    ``ran`` receives, for each launch, the kernel's name, what it reads and what it leaves.
    """
    arguments, worlds, dofs = (
        tuple(name for name in a if name not in (*VALUES, *TURNING_VALUES)),
        len(a["q"]),
        scene.dof_count,
    )
    names = (*arguments, "dt", "passes", "number")
    laws = contact_pass.count_law_variables(trace_of(scene, names))
    count = contact_pass.count_variables(Links(scene, variable(scene)), laws)
    weighed = SIZES["P"] * len(contact_pass.weighed_segments(trace_of(scene, names)))
    back_names = (*names, "qdd", "solved", "q_cotangent", "qd_cotangent")
    kernels = {
        "contact_pass": contact_pass.contact_pass(trace_of(scene, names), laws),
        "contact_solve": contact_derivatives.contact_solve(trace_of(scene, back_names), laws),
        "contact_gradient": contact_derivatives.contact_gradient(trace_of(scene, back_names), laws, wrt, True),
    }
    blank = lambda *size: np.full((worlds, *size), np.nan)  # noqa: E731
    known = a | {"dt": np.full((worlds, 1), h), "passes": np.full((worlds, 1), float(passes))}
    known |= dict(zip(("q_cotangent", "qd_cotangent"), cotangents, strict=True))
    known[GROUND] = cells_of(known)
    surfaces = sum(map(len, surface_numbers(scene, varies=HEIGHTS in a)))
    shapes = {name: a[name].shape[1:] for name in wrt} | ({HEIGHTS: (surfaces, CORNERS)} if HEIGHTS in wrt else {})

    def run(kernel, **found):
        store(kernels[kernel], known, found)
        if ran is not None:
            ran.append((kernel, dict(known), found))
        return found

    rates, rows = [blank(dofs)], [blank(count)]
    left, solved, inertias = [None] * passes + [blank(dofs + count)], [None] * passes, [None] * passes
    for number in range(passes):
        known |= {"number": np.full((worlds, 1), float(number)), "row": rows[-1], "qdd_before": rates[-1]}
        found = run("contact_pass", out=blank(dofs), row_out=blank(count))
        rates.append(found["out"])
        rows.append(found["row_out"])
    for number in reversed(range(passes)):
        known |= {"number": np.full((worlds, 1), float(number)), "row": rows[number], "qdd_before": rates[number],
                  "qdd": rates[number + 1], "cotangent": left[number + 1]}  # fmt: skip
        more = {f"{contact_derivatives.INERTIA}_out": blank(weighed)} if weighed else {}
        found = run("contact_solve", out=blank(dofs), cotangent_out=blank(dofs + count), **more)
        solved[number], left[number] = found["out"], found["cotangent_out"]
        inertias[number] = found.get(f"{contact_derivatives.INERTIA}_out")
    known |= {f"{name}_later": blank(*shape) for name, shape in shapes.items()}
    for number in reversed(range(passes)):
        known |= {"number": np.full((worlds, 1), float(number)), "row": rows[number], "qdd_before": rates[number],
                  "qdd": rates[number + 1], "cotangent": left[number + 1], "cotangent_came": left[number],
                  "solved": solved[number], contact_derivatives.INERTIA: inertias[number]}  # fmt: skip
        found = {contact_derivatives.result_name(name, wrt): blank(*shape) for name, shape in shapes.items()}
        found |= {f"{contact_derivatives.HEIGHTS_AT}_bar": blank(surfaces)} if HEIGHTS in wrt else {}
        run("contact_gradient", **found)
        known |= {f"{name}_later": found[contact_derivatives.result_name(name, wrt)] for name in wrt}
    gradients = {name: known[f"{name}_later"] for name in wrt}
    if HEIGHTS in wrt:
        by_height = np.zeros((worlds, scene.ground.heights.size))
        cells = found[f"{contact_derivatives.HEIGHTS_AT}_bar"].astype(int)
        for corner, distance in enumerate(corner_steps(scene.ground)):
            np.add.at(by_height, (np.arange(worlds)[:, None], cells + distance), gradients[HEIGHTS][:, :, corner])
        gradients[HEIGHTS] = by_height.reshape(a[HEIGHTS].shape)
    return gradients


def differences(scene, a, h, passes, cotangents, name, advance=step, chosen=None):
    """Differences by the entries of an argument or value [world, entry], NaN where one crosses a switch.

    ``chosen`` entries alone, if they are given.
    """
    flat = a[name].reshape(len(a[name]), -1)
    chosen = np.arange(flat.shape[1]) if chosen is None else chosen
    worlds, entries = len(flat), len(chosen)
    sizes = np.full(flat.shape, STEP[name]) if name in STEP else RELATIVE * np.maximum(abs(flat), 1e-2)
    moved = np.tile(flat, (entries * len(FOURTH), 1, 1))  # [entry and copy, world, entry]
    for at in range(entries):
        for copy, (share, _) in enumerate(FOURTH):
            moved[at * len(FOURTH) + copy, :, chosen[at]] += share * sizes[:, chosen[at]]
    many = {n: np.tile(x, (entries * len(FOURTH), *[1] * (x.ndim - 1))) for n, x in a.items()}
    many[name] = moved.reshape(-1, *a[name].shape[1:])
    q, qd, answers = advance(scene, many, h, passes)
    found = np.zeros((worlds, entries))
    sums = sum((x.reshape(-1, worlds, x.shape[1]) * c).sum(axis=2) for x, c in zip((q, qd), cotangents, strict=True))
    answers = answers.reshape(entries, len(FOURTH), worlds, -1)
    crossed = (answers != answers[:, :1]).any(axis=(1, 3)).T
    for at in range(entries):
        weighted = sum(w * sums[at * len(FOURTH) + copy] for copy, (_, w) in enumerate(FOURTH))
        found[:, at] = weighted / (12.0 * sizes[:, chosen[at]])
    return np.where(crossed, np.nan, found)


def draw_cotangents(a, seed):
    rng = np.random.default_rng(seed)
    return [rng.normal(size=a[name].shape) for name in ("q", "qd")]


def errors(scene, a, h, passes, seed=0, names=None, wanted=None):
    """By name: the largest error of a gradient over the world's largest entry, and the share of entries at switches.

    ``wanted``: differences by name with the cotangents of ``seed``; None: they are taken here.
    """
    cotangents, wrt = draw_cotangents(a, seed), tuple(names or a)
    found, errors = gradient(scene, a, h, passes, cotangents, wrt), {}
    for name in wrt:
        mine, chosen = found[name].reshape(len(a[name]), -1), None
        if name == HEIGHTS:  # those that points stand on, and a few others
            touched = mine.any(axis=0)
            chosen = np.append(np.flatnonzero(touched), np.flatnonzero(~touched)[:: len(touched) // OTHERS])
            mine = mine[:, chosen]
        true = wanted[name] if wanted else differences(scene, a, h, passes, cotangents, name, chosen=chosen)
        assert np.isfinite(mine).all(), name
        scale = np.maximum(abs(mine).max(axis=1, keepdims=True), 1e-12)
        errors[name] = np.nanmax(abs(mine - true) / scale), np.isnan(true).mean()
    return errors
