"""A crane with a flexible boom turns by 45 degrees: haste makes boom and load swing, a shaped command does not.

Every two worlds turn in another time, one by full acceleration, then full braking, one by the mean of four copies of
that, late by half a period of the load, of the boom, of both, of neither: what they excite cancels (input shaping).
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing
from warp_spo.examples.parts import about, at, oscillations
from warp_spo.viewing.charts import OURS, OURS_DARK

STEEL, SLENDER = spo.Material(7850.0, 2.1e11), dict(damping_ratio=0.005, rotary=False)
MAST, BOOM, JIB = (12.0, 0.45, 0.02), (18.0, 0.3, 0.01), (8.0, 0.15, 0.008)  # length, radius, wall [m]
COUNTS = ({"y": 1, "torsion": 1}, {"y": 2, "z": 1}, {"y": 1})  # modes of the three; y is sideways, z up


def scene(counts=COUNTS, points=4):
    """Return mast, boom and jib, the mass of each in some points, and a load on 6 m of rope."""
    tubes = [spo.beam_modes(length, spo.Section.tube(*wall), STEEL, "clamped", count, points=points, **SLENDER)
             for (length, *wall), count in zip((MAST, BOOM, JIB), counts, strict=True)]  # fmt: skip
    tilt, drive, turns = lambda a: about((0, 1, 0), a), dict(target_ke=1e9, target_kd=1e8), ((1, 0, 0), (0, 1, 0))
    seats = [at(turn=tilt(-np.pi / 2)), at(12.0, turn=tilt(np.pi / 2 - 0.5)), at(18.0, turn=tilt(0.5)), at(8.0)]
    kinds, more = ("revolute", "revolute", "fixed", "universal"), [dict(axis=axis, **drive) for axis in turns]
    more += [{}, dict(axis=turns, damping=50.0)]
    bodies = [*(spo.Body(*tube.rigid, modes=tube) for tube in tubes), spo.Body(300.0, (0, 0, -6.0))]
    return spo.Scene(bodies, [spo.Hinge(kinds[k], k - 1, k, parent_pose=seats[k], **more[k]) for k in range(4)])


def main(seconds=5.0, dt=5e-3, worlds=32, device=None, picture=None):
    crane, times = scene(), np.repeat(np.linspace(5.0, 15.0, -(-worlds // 2)), 2)[:worlds]
    dyn, (q, qd, target) = spo.Dynamics(crane, worlds, device, "float64"), np.zeros((3, worlds, crane.dof_count))
    for _ in range(100):
        q, _ = dyn.step(q, 0.0 * qd, None, 0.2)  # to rest under its weight
    rates, shapes = oscillations(crane, q[:1], qd[:1], dt, device)
    sideways = np.abs(shapes[:, -2]) > np.abs(shapes[:, -1])  # the rope about the jib's axis, and across
    load, boom = 2.0 * np.pi / np.sort(rates[sideways & (rates > 0.01)])[:2]
    early = np.where(np.arange(worlds) % 2, [[0.0], [load], [boom], [load + boom]], 0.0) / 2.0
    ticks, motion = np.arange(-15.0 - early.max(), seconds, dt), []  # all commands end at 0
    for t in ticks:
        s = np.clip(1.0 + (t + early) / times, 0.0, 1.0)
        target[:, 0] = np.pi / 4.0 * np.where(s < 0.5, 2.0 * s**2, 1.0 - 2.0 * (1.0 - s) ** 2).mean(0)
        q, qd = dyn.step(q, qd, None, dt, target_q=target)
        motion.append(100.0 * q[:, 4:6].sum(1))  # of the boom's tip, sideways [cm]: shapes are 1 there
    left = np.abs(motion)[ticks > 0.0].max(0)
    print(f"After the turn the tip swings by {left[::2].max():.1f} cm, shaped by {left[1::2].max(initial=0):.1f} cm.")
    if picture:
        with drawing(picture, "Slewing in 5 s, shaped in 8 s", "What is left") as (first, second):
            for k, color, name in ((0, OURS, "full acceleration, full braking"), (1, OURS_DARK, "shaped")):
                first.plot(ticks, np.array(motion)[:, k], color=color, label=name)
                second.plot((times + early[3])[k::2], left[k::2], ".-", color=color, label=name)
            first.set(xlabel="time after the command [s]", ylabel="boom's tip, sideways [cm]", xlim=(-9.0, seconds))
            second.set(xlabel="length of the command [s]", ylabel="boom's tip, sideways, after it [cm]")
    return left


if __name__ == "__main__":
    command(main)
