"""Gradients of steps of bodies that touch, beside differences of the compiled steps, away from switches."""

import numpy as np
import torch

import warp_spo as spo
from warp_spo.examples.parts import at

H, HALF, TIP = 5e-3, 0.05, 0.03  # time step [s], half the side of the cube, radius of the tip [m]
SHAPES = {
    "sphere": dict(sphere=((0.0, 0.0, 0.0), TIP)),
    "capsule": dict(capsule=((0.0, -0.04, 0.0), (0.0, 0.06, 0.0), TIP)),
    "box": dict(box=((TIP, 0.04, 0.03), (0.0, 0.0, 0.0, 0.02, 0.03, 0.05, np.sqrt(1.0 - 0.0038)))),
}
FOURTH = ((1.0, 8.0), (-1.0, -8.0), (2.0, -1.0), (-2.0, 1.0))  # moves, and weights in twelve steps
SIZES = {"x": 1e-6, "qd": 1e-5, "tau": 1e-3, "body_f": 1e-3, "target_q": 1e-4, "target_qd": 1e-3, "ctrl": 2e-3}
# By target_qd, moves of 1e-4 leave 2.5e-6 of the gradient to rounding of the state, and 1e-5 ten times that.
SAME = 1e-4  # share of an entry by which differences of two sizes agree where there is no switch


def finger(shape="sphere", friction=0.5, ground=0.5, **more):
    """A finger of two hinges whose tip touches a cube on the ground; q is the hinges and the cube's pose."""
    bar = spo.Body(0.2, (0.0, 0.0, -0.1), 7e-4 * np.eye(3))
    drive = dict(armature=0.01, damping=0.05, **more)
    hinges = [
        spo.Hinge("revolute", -1, 0, axis=(0, 1, 0), parent_pose=at(z=0.4), **drive),
        spo.Hinge("revolute", 0, 1, axis=(0, 1, 0), parent_pose=at(z=-0.2), **drive),
        spo.Hinge("free", -1, 2),
    ]
    cube = spo.Body(0.5, inertia=0.5 * (2.0 * HALF) ** 2 / 6.0 * np.eye(3))
    box = dict(box=(HALF, HALF, HALF))
    tip = _moved(SHAPES[shape])
    contacts = [
        spo.Contact(2, **box, friction=ground),
        spo.Contact(1, **tip, other=spo.Contact(2, **box), friction=friction),
    ]
    return spo.Scene([bar, bar, cube], hinges, contacts=contacts, ground=spo.Plane())


def _moved(shape):
    """The shape at the end of the second bar."""
    down = np.array([0.0, 0.0, -0.2])
    ((kind, value),) = shape.items()
    if kind == "sphere":
        return {kind: (tuple(value[0] + down), value[1])}
    if kind == "capsule":
        return {kind: (tuple(value[0] + down), tuple(value[1] + down), value[2])}
    return {kind: (value[0], (*(np.array(value[1][:3]) + down), *value[1][3:]))}


def touching(scene, worlds=2, speed=0.3, seed=0):
    """Return q, qd, tau in which the tip is some tenths of a millimetre in the cube."""
    rng = np.random.default_rng(seed)
    q, qd = np.tile(scene.neutral_q, (worlds, 1)), 0.1 * speed * rng.normal(size=(worlds, scene.dof_count))
    q[:, :2] = [0.9, -1.1]
    q[:, 2:5] = [0.0, 0.004, HALF - 2e-4]
    turns = np.concatenate([2e-3 * rng.normal(size=(worlds, 2)), 0.05 * rng.normal(size=(worlds, 1))], axis=1)
    q[:, 5:] = np.concatenate([turns, np.sqrt(1.0 - (turns * turns).sum(axis=1, keepdims=True))], axis=1)
    dyn = spo.Dynamics(scene, worlds, "cpu", "float64")
    for _ in range(40):  # the cube comes to where the tip touches
        gap = dyn.step_report("contact_gap", like=q)
        dyn.step(q, np.zeros_like(qd), None, 1e-6, report=gap)
        away = np.minimum(gap.contact_gap[:, -1], 0.02) + 4e-4
        q[:, 2] -= away
        if (np.abs(away) < 1e-5).all():
            break
    qd[:, 0] -= speed
    return q, qd, 0.5 * rng.normal(size=qd.shape)


def tensors(dyn, a):
    return {name: torch.tensor(x, dtype=torch.float64, requires_grad=True) for name, x in a.items()}


def outcome(dyn, q, a, cotangents, steps=1, options=None):
    """Sum of cotangents times the state after some steps [world], from q moved by "x"."""
    more = {name: a[name] for name in a if name not in ("x", "qd", "tau")}
    options = {} if options is None else {"options": options}
    q, qd = dyn.integrate(q, a["x"], 1.0), a["qd"]
    for _ in range(steps):
        q, qd = dyn.step(q, qd, a["tau"], H, **more, **options)
    return sum((state * weight).sum(1) for state, weight in zip((q, qd), cotangents, strict=True))


def errors(dyn, q, a, steps=1, options=None, seed=0):
    """By name: the largest error of a gradient over the world's largest entry, and the share of entries at switches.

    ``a``: arguments of the step by name; q is moved along the tangent, "x".
    """
    rng, worlds = np.random.default_rng(seed), len(q)
    q, a = torch.tensor(q), {"x": np.zeros((worlds, dyn.scene.dof_count)), **a}
    a, found = tensors(dyn, a), {}
    cotangents = [torch.tensor(rng.normal(size=(worlds, n))) for n in (dyn.scene.coord_count, dyn.scene.dof_count)]
    gradients = torch.autograd.grad(outcome(dyn, q, a, cotangents, steps, options).sum(), list(a.values()))
    for name, mine in zip(a, gradients, strict=True):
        wanted = torch.full_like(mine, torch.nan).reshape(worlds, -1)
        for entry in range(wanted.shape[1]):
            rates = []
            for size in (SIZES[name], 0.5 * SIZES[name]):
                rate = 0.0
                for share, weight in FOURTH:
                    moved = {n: t.detach().clone() for n, t in a.items()}
                    moved[name].reshape(worlds, -1)[:, entry] += share * size
                    moved[name].requires_grad_()
                    rate = rate + weight * outcome(dyn, q, moved, cotangents, steps, options).detach()
                rates.append(rate / (12.0 * size))
            same = abs(rates[0] - rates[1]) <= SAME * abs(mine.reshape(worlds, -1)).amax(1)
            wanted[:, entry] = torch.where(same, rates[1], torch.nan)
        mine = mine.reshape(worlds, -1)
        scale = abs(mine).amax(1, keepdim=True).clamp(min=1e-12)
        error = abs(mine - wanted) / scale
        found[name] = float(np.nanmax(error.numpy())), float(torch.isnan(wanted).double().mean())
    return found
