"""A beam on a spinning hub becomes stiffer as it spins; a model without that stiffening diverges.

A bent beam does not grow longer, so that its points come nearer to the hub, against the centrifugal force. The rates at
which it swings are those of Wright et al. (J. Appl. Mech. 49, 1982), in units of sqrt(EI / rho A) / L^2. The manoeuvre
is that of Kane, Ryan and Banerjee (J. Guidance 10, 1987): the hub is spun up, the tip lags behind and comes back.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing
from warp_spo.examples.parts import oscillations
from warp_spo.viewing.charts import FAINT, OURS, OURS_DARK

ACROSS = [3.5160, 4.1373, 5.5850, 7.3604, 9.2568, 11.2023, 13.1702]  # lowest rates at the spins 0, 2, ... 12
WITHIN = [3.5160, 3.6218, 3.8977, 4.2634, 4.6577, 5.0505, 5.4304]  # in the plane of rotation
HUB, MODES = 1e9, {"y": 5, "z": 3}  # inertia of a hub that the beam cannot turn; modes in the plane, across


def scene(stiffening=True):
    """Return the hub with a slender beam, EI = rho A = L = 1."""
    thin, more = (spo.Section(1.0, 1e-10, 1e-10), spo.Material(1.0, 1e10)), dict(points=9, rotary=False)
    modes = spo.beam_modes(1.0, *thin, "clamped", MODES, stiffening=stiffening, **more)
    hinge = spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), armature=HUB)
    return spo.Scene([spo.Body(*modes.rigid, modes=modes)], [hinge], gravity=(0, 0, 0))


def main(seconds=20.0, dt=5e-3, worlds=4, device=None, picture=None):
    spins, tops, rates, tips = np.linspace(0.0, 12.0, 25), np.linspace(2.0, 8.0, worlds), [], []
    state, ticks = spins[:, None] * np.eye(1, 9), np.arange(0.0, seconds, dt)
    for beam in (scene(), scene(stiffening=False)):
        found, shapes = oscillations(beam, 0.0 * state, state, 2e-4, device)
        across = np.abs(shapes[:, 6:9]).max(1) > np.abs(shapes[:, 1:6]).max(1)
        rates += [np.where((found > 1e-2) & kind, found, np.inf).min(1) for kind in (across, ~across)]
        dyn, (q, qd, tau), motion = spo.Dynamics(beam, worlds, device, "float64"), np.zeros((3, worlds, 9)), []
        for t in ticks:
            tau[:, 0] = HUB * tops / 15.0 * (1.0 - np.cos(2.0 * np.pi * t / 15.0)) * (t < 15.0)
            q, qd = dyn.step(q, qd, tau, dt)
            motion.append(q[:, 1:6].sum(1))  # of the tip, in the plane: shapes are 1 there
        tips.append(np.array(motion))
    error = max(np.abs(rates[k][::4] / (ACROSS, WITHIN)[k] - 1.0).max() for k in (0, 1))
    lost = np.abs(tips[1][-1]).max()
    print(f"Rates are within {error:.1%} of the published ones; without stiffening a tip ends {lost:.0e} lengths away.")
    if picture:
        with drawing(picture, "Lowest rates", "Tip, while the hub is spun up to 2 … 8") as (left, right):
            for k, color, line in ((0, OURS_DARK, "-"), (1, OURS, "-"), (2, OURS_DARK, ":"), (3, OURS, ":")):
                label = ("across the plane", "in the plane", "without stiffening", None)[k]
                left.plot(spins, np.where(rates[k] < 14.0, rates[k], np.nan), line, color=color, label=label)
                left.plot(spins[::4], (ACROSS, WITHIN)[k % 2], "o", color=FAINT, label="published" if k == 3 else None)
            for motion, line in zip(tips, ("-", ":"), strict=True):
                gone = np.maximum.accumulate(np.abs(motion)) > 0.12
                right.plot(ticks, np.where(gone, np.nan, motion), line, color=OURS)
            left.set(xlabel="spin", ylabel="rate")
            right.set(xlabel="time", ylabel="deflection in the plane, in lengths of the beam")
    return error, tips


if __name__ == "__main__":
    command(main)
