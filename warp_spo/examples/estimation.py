"""A robot as a filter: its mass matrix is the covariance of a noise that its bodies pass on to the root.

Give every body noise w with the covariance of its spatial inertia M(k), let phi pass the noise on from the tips to the
root, and measure it at the hinges: T = H phi w has the covariance H phi M phi* H*, which is the mass matrix. The Kalman
filter that predicts T has the operator psi and the gain K, and the covariance of its prediction errors, the
innovations, is D. They are independent from hinge to hinge: [I - H psi K] T is white (A. Jain, eq. 1).
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import FAINT, OURS


def arm(links=4):
    """Return an arm of bars that turn about z and y in turn."""
    axes = [(0, 1, 0) if k % 2 else (0, 0, 1) for k in range(links)]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=axes[k], parent_pose=at(0.5 * (k > 0))) for k in range(links)]
    return spo.Scene([bar(0.5, 1.0 + k) for k in range(links)], hinges)


def main(worlds=20_000, seed=0, device=None, picture=None):
    scene, rng = arm(), np.random.default_rng(seed)
    dyn = spo.Dynamics(scene, worlds, device, "float64")  # every world is one sample of the noise
    q = np.tile(rng.uniform(-1.0, 1.0, scene.coord_count), (worlds, 1))  # the same configuration in all of them
    ops = dyn.operators(q)

    # Noise with the covariance M: a Cholesky factor of M times independent unit noise.
    factor = np.linalg.cholesky(np.array(ops.M.dense())[0])
    w = rng.standard_normal((worlds, len(factor))) @ factor.T

    T = (ops.H @ ops.phi) @ w  # the measurement at the hinges [world, dof]
    innovations = T - (ops.H @ ops.psi @ ops.K) @ T

    errors, pairs = [], []
    for name, x, matrix in (
        ("measurement", T, dyn.mass_matrix(q)[0]),
        ("innovations", innovations, np.array(ops.D.dense())[0]),
    ):
        pairs.append((np.cov(x.T), matrix))
        errors.append(np.abs(np.cov(x.T) - matrix).max() / np.abs(matrix).max())
        expected = "the mass matrix" if name == "measurement" else "D, which is diagonal,"
        print(f"The covariance of the {name} is {expected} within {100 * errors[-1]:.1f} %.")
    print(f"{worlds} samples leave an error of about {100 * worlds**-0.5:.1f} %.")
    if picture:
        titles = "Covariance of the measurement", "Covariance of the innovations"
        with drawing(picture, *titles) as axes:
            for each, (found, exact), name in zip(axes, pairs, ("mass matrix", "D"), strict=True):
                sizes = np.diagonal(exact)
                spread = np.sqrt((np.outer(sizes, sizes) + exact**2) / worlds)  # of a sample covariance, Gaussian noise
                rows = np.triu_indices(len(exact))
                each.errorbar(exact[rows], (found - exact)[rows], 2.0 * spread[rows], fmt=".", color=OURS, capsize=3.0,
                              label=f"{worlds} samples ± 2 standard errors")  # fmt: skip
                each.axhline(0.0, color=FAINT, linestyle="--", linewidth=0.9, label="exact")
                each.set(xlabel=f"entry of {name} [kg m²]", ylabel="found minus exact [kg m²]")
    return errors


if __name__ == "__main__":
    command(main)
