"""A robot as a filter: its mass matrix is the covariance of a process that noise drives from the tips to the root.

Give every body noise with the covariance of its spatial inertia M(k), pass it on inward by phi, and look at the hinges:
T = H phi w has the covariance H phi M phi* H* = Mass. The filter that predicts T is psi, its gain G, the covariance of
what it did not predict D: [I - H psi K] T is white, hinge by hinge (A. Jain, eq. 1).
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.parts import at, bar


def arm(links=4):
    """Bars that turn about y and z in turn."""
    axes = [(0, 1, 0) if k % 2 else (0, 0, 1) for k in range(links)]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=axes[k], parent_pose=at(0.5 * (k > 0))) for k in range(links)]
    return spo.Scene([bar(0.5, 1.0 + k) for k in range(links)], hinges)


def main(samples=20_000, seed=0):
    scene, rng = arm(), np.random.default_rng(seed)
    dyn = spo.Dynamics(scene, worlds=samples, dtype="float64")
    q = np.tile(rng.uniform(-1.0, 1.0, scene.coord_count), (samples, 1))
    ops = dyn.operators(q)
    root = np.linalg.cholesky(np.array(ops.M.dense())[0])
    w = rng.standard_normal((samples, len(root))) @ root.T
    T = (ops.H @ ops.phi) @ w  # what is measured
    innovation = T - (ops.H @ ops.psi @ ops.K) @ T
    Mass, D = dyn.mass_matrix(q)[0], np.array(ops.D.dense())[0]
    errors = [np.abs(np.cov(x.T) - wanted).max() / np.abs(wanted).max() for x, wanted in ((T, Mass), (innovation, D))]
    print(
        f"{samples} samples: the covariance of T is Mass up to {errors[0]:.1e}, that of the innovations is D up to "
        f"{errors[1]:.1e}; chance leaves {samples**-0.5:.0e}"
    )
    return errors


if __name__ == "__main__":
    main()
