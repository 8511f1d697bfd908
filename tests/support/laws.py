"""Laws that every operation of Dynamics obeys: functions that raise AssertionError; test_planted_bugs.py breaks them.

An operation is a name in OPERATIONS: which arrays it takes, and how the dense reference computes it for one world.
"""

import functools

import numpy as np
import warp as wp

from warp_spo.reference import dense as reference
from warp_spo.scene.parts import SCREWS

from . import zoo

FRAMES = [0, (-1, (0.1, -0.2, 0.3, 0.0, 0.6, 0.0, 0.8))]  # -1: the scene's last body
STEP = 0.05

TOLERANCE = {
    "float64": 2e-12,  # cond(M) of the worst scene is 1e4
    "float32": 3e-5,  # the same, times the rounding of float32; typical errors are 1e-6
}

# name -> (arrays it takes after q, the reference's value for one world)
OPERATIONS = {
    "forward_dynamics": (("qd", "tau", "body_f"), lambda d, s: d.forward_dynamics(s["qd"], s["tau"], s["body_f"])),
    "inverse_dynamics": (("qd", "qdd", "body_f"), lambda d, s: d.inverse_dynamics(s["qd"], s["qdd"], s["body_f"])),
    "bias_force": (("qd", "body_f"), lambda d, s: d.bias_force(s["qd"], s["body_f"])),
    "gravity_force": ((), lambda d, s: d.gravity_force),
    "mass_matrix": ((), lambda d, s: d.mass_matrix),
    "mass_matrix_inverse": ((), lambda d, s: np.linalg.inv(d.mass_matrix)),
    "solve_mass_matrix": (("b",), lambda d, s: np.linalg.solve(d.mass_matrix, s["b"])),
    "log_det_mass_matrix": ((), lambda d, s: d.log_det),
    "passive_force": (("qd",), lambda d, s: d.passive_force(s["qd"])),
    "body_poses": ((), lambda d, s: d.body_poses),
    "body_velocities": (("qd",), lambda d, s: d.body_velocities(s["qd"])),
    "jacobian": (("frames",), lambda d, s: d.jacobian(s["frames"])),
    "operational_inertia_inverse": (("frames",), lambda d, s: d.operational_inertia_inverse(s["frames"])),
    "integrate": (("qd", "dt"), lambda d, s: d.integrate(s["qd"], STEP)),
}


def frames_of(scene):
    last = scene.body_count - 1
    return [frame if isinstance(frame, int) else (last, frame[1]) for frame in FRAMES]


def states(scene, worlds, seed=0, dtype="float64"):
    """One array for every name in OPERATIONS, different in every world, rounded to ``dtype`` and held in float64."""
    rng = np.random.default_rng(seed)
    q, qd, tau = zoo.random_state(scene, worlds, seed)
    arrays = {"q": q, "qd": qd, "tau": tau, "qdd": rng.normal(size=qd.shape)}
    arrays["b"] = rng.normal(size=(*qd.shape, 3))
    arrays["body_f"] = rng.normal(size=(worlds, scene.body_count, 6))
    return {name: array.astype(dtype).astype(np.float64) for name, array in arrays.items()}


def to_device(dyn, arrays):
    return {name: wp.array(array, dtype=dyn.dtype, device=dyn.device) for name, array in arrays.items()}


def numbers(array):
    """Return an array of any kind and device as NumPy float64."""
    array = array.detach().cpu() if hasattr(array, "detach") else array
    return np.asarray(array.numpy() if hasattr(array, "numpy") else array, dtype=np.float64)


def call(dyn, name, arrays, out=None):
    """The operation's result for ``arrays``, a dictionary as :func:`states` makes it, of any kind."""
    fixed = {"frames": frames_of(dyn.scene), "dt": STEP}
    takes = OPERATIONS[name][0]
    return getattr(dyn, name)(arrays["q"], *[fixed.get(n, arrays.get(n)) for n in takes], out=out)


def numpy_call(dyn, name, arrays):
    return np.asarray(call(dyn, name, to_device(dyn, arrays)).numpy(), dtype=np.float64)


@functools.lru_cache(maxsize=64)
def _dense(scene, q, world):
    return reference.Dense(scene, np.frombuffer(q), world=world)


def dense(scene, q, world):
    """Return the dense reference of one world; operations of one state share it, for it is slow."""
    return _dense(scene, np.asarray(q, np.float64).tobytes(), world)


def expected(dyn, name, arrays, world):
    """The dense reference's result for one world."""
    state = {key: array[world] for key, array in arrays.items()} | {"frames": frames_of(dyn.scene)}
    return OPERATIONS[name][1](dense(dyn.scene, state["q"], world), state)


def same_quaternion_sign(name, scene, got, wanted):
    """A quaternion and its negative are one rotation: take the sign of ``wanted``."""
    got = got.copy()
    if name == "body_poses":
        got[:, 3:] *= np.where((got[:, 3:] * wanted[:, 3:]).sum(-1, keepdims=True) < 0, -1, 1)
    if name == "integrate":
        for hinge, start in zip(scene.hinges, scene.q_start, strict=False):
            if hinge.motion != SCREWS:
                part = slice(start + hinge.coord_count - 4, start + hinge.coord_count)
                got[part] *= np.where(got[part] @ wanted[part] < 0, -1, 1)
    return got


def error(got, wanted):
    """Largest difference over the largest magnitude; NaN counts as infinite."""
    if got.size == 0:
        return 0.0
    difference = np.abs(got - wanted).max() / max(np.abs(wanted).max(), 1e-3)
    return difference if np.isfinite(difference) else np.inf


def equals_reference(dyn, name, arrays, tolerance):
    result = numpy_call(dyn, name, arrays)
    for world in range(dyn.worlds):
        wanted = np.asarray(expected(dyn, name, arrays, world))
        got = same_quaternion_sign(name, dyn.scene, result[world], wanted)
        assert error(got, wanted) <= tolerance, f"{name}, world {world}: error {error(got, wanted):.1e}"


def every_entry_is_written(dyn, name, arrays):
    on_device = to_device(dyn, arrays)
    first = call(dyn, name, on_device)
    poisoned = wp.full(first.shape, float("nan"), dtype=dyn.dtype, device=dyn.device)
    assert call(dyn, name, on_device, out=poisoned) is poisoned
    assert np.isfinite(poisoned.numpy()).all()  # fresh memory may hold the NaN of an earlier test
    np.testing.assert_array_equal(poisoned.numpy(), first.numpy())


def worlds_do_not_touch_each_other(dyn, name, arrays):
    """NaN in every input of one world: all other worlds keep their bits, and that world shows it."""
    clean = numpy_call(dyn, name, arrays)
    for spoiled in {0, dyn.worlds // 2, dyn.worlds - 1}:
        broken = {key: array.copy() for key, array in arrays.items()}
        for array in broken.values():
            array[spoiled] = np.nan
        result = numpy_call(dyn, name, broken)
        others = np.arange(dyn.worlds) != spoiled
        np.testing.assert_array_equal(result[others], clean[others])
        assert result[spoiled].size == 0 or np.isnan(result[spoiled]).any(), f"{name}: world {spoiled} hides its NaN"


def same_bits_in_every_order(dyn, name, arrays):
    """Run again, then with the worlds in another order."""
    first = numpy_call(dyn, name, arrays)
    np.testing.assert_array_equal(numpy_call(dyn, name, arrays), first)
    order = np.random.default_rng(7).permutation(dyn.worlds)
    shuffled = numpy_call(dyn, name, {key: array[order] for key, array in arrays.items()})
    np.testing.assert_array_equal(shuffled, first[order])


def inverse_dynamics_columns_are_the_mass_matrix(dyn, arrays, tolerance):
    mass = numpy_call(dyn, "mass_matrix", arrays)
    still = wp.array(arrays["q"], dtype=dyn.dtype, device=dyn.device)
    bias = dyn.gravity_force(still).numpy()
    for dof in range(dyn.scene.dof_count):
        unit = np.zeros((dyn.worlds, dyn.scene.dof_count))
        unit[:, dof] = 1.0
        qdd = wp.array(unit, dtype=dyn.dtype, device=dyn.device)
        column = dyn.inverse_dynamics(still, None, qdd).numpy() - bias
        assert error(column, mass[:, :, dof]) <= tolerance, f"column {dof}"


def forward_undoes_inverse_dynamics(dyn, arrays, tolerance):
    a = to_device(dyn, arrays)
    tau = dyn.inverse_dynamics(a["q"], a["qd"], a["qdd"], a["body_f"])
    qdd = dyn.forward_dynamics(a["q"], a["qd"], tau, a["body_f"]).numpy()
    assert error(qdd, arrays["qdd"]) <= tolerance


def bias_force_is_christoffel(dyn, arrays, tolerance):
    """Velocity terms against the derivative of the mass matrix: a wrong gyroscopic sign cannot pass.

    Along the motion q(t) of constant qd, M' qd - d/dq (qd.M qd)/2 = bias(qd) - bias(0); for hinges whose qd is the
    derivative of q.
    """
    h = 1e-5
    a = {key: value.astype(np.float64) for key, value in arrays.items()}

    def mass(q):
        return dyn.mass_matrix(q)

    rate = (mass(a["q"] + h * a["qd"]) - mass(a["q"] - h * a["qd"])) / (2 * h)
    wanted = np.einsum("wij,wj->wi", rate, a["qd"])
    for dof in range(dyn.scene.dof_count):
        unit = np.zeros_like(a["q"])
        unit[:, dof] = h
        slope = (mass(a["q"] + unit) - mass(a["q"] - unit)) / (2 * h)
        wanted[:, dof] -= 0.5 * np.einsum("wi,wij,wj->w", a["qd"], slope, a["qd"])
    got = dyn.bias_force(a["q"], a["qd"]) - dyn.gravity_force(a["q"])
    assert error(got, wanted) <= tolerance


def adjoint(operator, worlds, tolerance, seed=0):
    """<A x, z> = <x, A.T z> in every world."""
    rng = np.random.default_rng(seed)
    x, z = (rng.normal(size=(worlds, size)) for size in operator.shape[::-1])
    left = np.einsum("wi,wi->w", np.asarray(operator @ x, np.float64), z)
    right = np.einsum("wi,wi->w", x, np.asarray(operator.T @ z, np.float64))
    assert error(left, right) <= tolerance


def sweep_is_the_dense_resolvent(resolvent, worlds, tolerance, seed=0):
    """A x and A.T x against the dense (I - E)^-1 x in float64, every world."""
    E = resolvent.E.dense()
    x = np.random.default_rng(seed).normal(size=(worlds, E.shape[1])).astype(E.dtype)
    for operator, axes in ((resolvent, (0, 1, 2)), (resolvent.T, (0, 2, 1))):
        got = np.asarray(operator @ x, dtype=np.float64)
        for first in range(0, worlds, 256):  # dense matrices of all worlds at once take gigabytes
            chunk = slice(first, first + 256)
            matrix = np.eye(E.shape[1]) - (E[chunk] if len(E) > 1 else E).astype(np.float64).transpose(axes)
            wanted = np.linalg.solve(matrix, x[chunk, :, None].astype(np.float64))[..., 0]
            distance = np.linalg.norm(got[chunk] - wanted, axis=1) / np.linalg.norm(wanted, axis=1)
            assert distance.max() <= tolerance, f"world {first + distance.argmax()}: {distance.max():.1e}"


def entries(field):
    """A field of the scene's values as [entry, world], whether it lies in tiles of worlds or not."""
    values = field.numpy()
    return values if values.ndim == 2 else values.transpose(1, 0, 2).reshape(values.shape[1], -1)
