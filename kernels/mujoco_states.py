"""States, accelerations and forces of MuJoCo and of a scene, each from the other.

qpos and q differ in the order of quaternions, w x y z and x y z w. Angular velocities of ball and free joints are in
the body's axes in qvel, and in those of the parent anchor in qd: ``w_qd = R w_qvel``, R being the rotation of the
joint's quaternion, normalised. The first three rates of a free joint are the velocity of the body frame's origin in
qvel, and that of the centre of mass c (in the body frame) in qd: ``v_qd = v_qvel + w_qd x R c``. Their time derivatives
give ``dw_qd = R dw_qvel``, because ``w x w`` is zero, and ``dv_qd = dv_qvel + dw_qd x R c + w_qd x (w_qd x R c)``.
Forces have the same power in both: ``f_tau = f_qfrc`` and ``n_tau = R n_qfrc - R c x f``. Sources: MuJoCo's
documentation, "Computation: Floating objects"; Newton's conventions for joint_q and joint_qd.
"""

import functools

import warp as wp


@functools.cache
def gather(T) -> wp.Kernel:
    """Compute ``out[world, i] = x[world, source[i]]``."""

    @wp.kernel(module=f"warp_spo_mujoco_{T.__name__}", enable_backward=False)
    def kernel(source: wp.array[int], x: wp.array2d[T], out: wp.array2d[T]):
        world, i = wp.tid()
        out[world, i] = x[world, source[i]]

    return kernel


@functools.cache
def rotation(T) -> wp.Function:
    """Return the function for the rotation of a quaternion among coordinates, which need not be of unit length."""
    Matrix = wp.types.matrix((3, 3), T)

    @wp.func
    def function(q: wp.array2d[T], world: int, vector: int, real: int) -> Matrix:
        x, y, z, w = q[world, vector], q[world, vector + 1], q[world, vector + 2], q[world, real]
        s = T(2.0) / ((x * x + y * y) + (z * z + w * w))
        one = T(1.0)
        return Matrix(
            one - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
            s * (x * y + w * z), one - s * (x * x + z * z), s * (y * z - w * x),
            s * (x * z - w * y), s * (y * z + w * x), one - s * (x * x + y * y),
        )  # fmt: skip

    return function


@functools.cache
def three(T) -> wp.Function:
    """Return the function for the vector of three entries of a row."""
    Vector = wp.types.vector(3, T)

    @wp.func
    def function(x: wp.array2d[T], world: int, first: int) -> Vector:
        return Vector(x[world, first], x[world, first + 1], x[world, first + 2])

    return function


@functools.cache
def store_three(T) -> wp.Function:
    """Return the function that writes a vector to three entries of a row."""
    Vector = wp.types.vector(3, T)

    @wp.func
    def function(x: Vector, world: int, first: int, out: wp.array2d[T]):
        for i in range(3):
            out[world, first + i] = x[i]

    return function


@functools.cache
def change_axes(T) -> wp.Function:
    """Return the function ``R x``, from the body's axes to the parent's, or ``R* x``."""
    Vector, Matrix = wp.types.vector(3, T), wp.types.matrix((3, 3), T)

    @wp.func
    def function(to_parent: bool, R: Matrix, x: Vector) -> Vector:
        result = wp.transpose(R) * x
        if to_parent:
            result = R * x
        return result

    return function


@functools.cache
def turn_joint(T) -> wp.Function:
    """Return the function that writes the entries of a joint that is not free, and returns a joint's rotation."""
    Matrix, rotate, entries, store, change = (
        wp.types.matrix((3, 3), T),
        rotation(T),
        three(T),
        store_three(T),
        change_axes(T),
    )

    @wp.func
    def function(
        to_scene: bool,
        kind: int,
        coordinates: wp.array2d[T],
        world: int,
        vector: int,
        real: int,
        first: int,
        x: wp.array2d[T],
        out: wp.array2d[T],
    ) -> Matrix:
        R = Matrix()
        if kind == 0:
            out[world, first] = x[world, first]
        else:
            R = rotate(coordinates, world, vector, real)
            if kind == 1:
                store(change(to_scene, R, entries(x, world, first)), world, first, out)
        return R

    return function


def vectors(T) -> tuple:
    """Return the type of a vector, and the functions that turn, read and write vectors of a joint."""
    return wp.types.vector(3, T), turn_joint(T), three(T), store_three(T)


@functools.cache
def rates(T) -> wp.Kernel:
    """Compute qd from qpos and qvel if ``to_scene``, else qvel from q and qd; a thread for each (world, joint).

    Arguments of the kernel:
        kind: 0 for a joint of one coordinate, 1 for a ball, 2 for a free joint.
        dof: first entry of the joint in qvel and qd.
        vector, real: entries of its quaternion in ``coordinates``: the first of x, y, z, and w.
        com: centre of mass of the body that the joint carries, in the body frame [m].
    """
    Vector, turn, entries, store = vectors(T)
    change = change_axes(T)

    @wp.kernel(module=f"warp_spo_mujoco_{T.__name__}", enable_backward=False)
    def kernel(
        to_scene: bool,
        kind: wp.array[int],
        dof: wp.array[int],
        vector: wp.array[int],
        real: wp.array[int],
        com: wp.array3d[T],
        coordinates: wp.array2d[T],
        x: wp.array2d[T],
        out: wp.array2d[T],
    ):
        world, joint = wp.tid()
        first = dof[joint]
        R = turn(to_scene, kind[joint], coordinates, world, vector[joint], real[joint], first, x, out)
        if kind[joint] < 2:
            return
        given = entries(x, world, first + 3)
        result = change(to_scene, R, given)
        store(result, world, first + 3, out)
        arm = R * Vector(com[world, joint, 0], com[world, joint, 1], com[world, joint, 2])
        v = entries(x, world, first)
        if to_scene:
            v += wp.cross(result, arm)
        else:
            v -= wp.cross(given, arm)
        store(v, world, first, out)

    return kernel


@functools.cache
def accelerations(T) -> wp.Kernel:
    """Compute qdd from qpos, qvel and qacc if ``to_scene``, else qacc from q, qd and qdd; arguments as of `rates`."""
    Vector, turn, entries, store = vectors(T)
    change = change_axes(T)

    @wp.kernel(module=f"warp_spo_mujoco_{T.__name__}", enable_backward=False)
    def kernel(
        to_scene: bool,
        kind: wp.array[int],
        dof: wp.array[int],
        vector: wp.array[int],
        real: wp.array[int],
        com: wp.array3d[T],
        coordinates: wp.array2d[T],
        velocity: wp.array2d[T],
        x: wp.array2d[T],
        out: wp.array2d[T],
    ):
        world, joint = wp.tid()
        first = dof[joint]
        R = turn(to_scene, kind[joint], coordinates, world, vector[joint], real[joint], first, x, out)
        if kind[joint] < 2:
            return
        given, w = entries(x, world, first + 3), entries(velocity, world, first + 3)
        result = change(to_scene, R, given)
        store(result, world, first + 3, out)
        arm = R * Vector(com[world, joint, 0], com[world, joint, 1], com[world, joint, 2])
        a = entries(x, world, first)
        if to_scene:
            w = R * w
            a += wp.cross(result, arm) + wp.cross(w, wp.cross(w, arm))
        else:
            a -= wp.cross(given, arm) + wp.cross(w, wp.cross(w, arm))
        store(a, world, first, out)

    return kernel


@functools.cache
def forces(T) -> wp.Kernel:
    """Compute tau from qpos and qfrc if ``to_scene``, else qfrc from q and tau; arguments as of `rates`."""
    Vector, turn, entries, store = vectors(T)

    @wp.kernel(module=f"warp_spo_mujoco_{T.__name__}", enable_backward=False)
    def kernel(
        to_scene: bool,
        kind: wp.array[int],
        dof: wp.array[int],
        vector: wp.array[int],
        real: wp.array[int],
        com: wp.array3d[T],
        coordinates: wp.array2d[T],
        x: wp.array2d[T],
        out: wp.array2d[T],
    ):
        world, joint = wp.tid()
        first = dof[joint]
        R = turn(to_scene, kind[joint], coordinates, world, vector[joint], real[joint], first, x, out)
        if kind[joint] < 2:
            return
        f, n = entries(x, world, first), entries(x, world, first + 3)
        store(f, world, first, out)
        arm = R * Vector(com[world, joint, 0], com[world, joint, 1], com[world, joint, 2])
        if to_scene:
            n = R * n - wp.cross(arm, f)
        else:
            n = wp.transpose(R) * (n + wp.cross(arm, f))
        store(n, world, first + 3, out)

    return kernel


KERNELS = (gather, rates, accelerations, forces)
