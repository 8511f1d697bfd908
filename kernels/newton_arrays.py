"""Copies between Newton's flat arrays of all worlds and arrays [world, entry]."""

import functools

import warp as wp


@functools.cache
def gather(T) -> wp.Kernel:
    """Set ``out[world, i] = flat[index[world, i]]``."""

    @wp.kernel(module=f"warp_spo_exchange_{T.__name__}", enable_backward=False)
    def kernel(index: wp.array2d[int], flat: wp.array[T], out: wp.array2d[T]):
        world, i = wp.tid()
        out[world, i] = flat[index[world, i]]

    return kernel


@functools.cache
def scatter(T) -> wp.Kernel:
    """Set ``flat[index[world, i]] = array[world, i]`` in the worlds where ``mask`` is True; without a mask, in all."""

    @wp.kernel(module=f"warp_spo_exchange_{T.__name__}", enable_backward=False)
    def kernel(index: wp.array2d[int], mask: wp.array[wp.bool], array: wp.array2d[T], flat_out: wp.array[T]):
        world, i = wp.tid()
        if mask:
            if not mask[world]:
                return
        flat_out[index[world, i]] = array[world, i]

    return kernel


@functools.cache
def scale(T) -> wp.Kernel:
    """Set ``out[world, i] = factor[i] array[world, i]``; a factor of zero gives zero even where ``array`` holds NaN."""

    @wp.kernel(module=f"warp_spo_exchange_{T.__name__}", enable_backward=False)
    def kernel(factor: wp.array[T], array: wp.array2d[T], out: wp.array2d[T]):
        world, i = wp.tid()
        out[world, i] = wp.where(factor[i] == T(0.0), T(0.0), factor[i] * array[world, i])

    return kernel


@functools.cache
def add(T) -> wp.Kernel:
    """Add: ``flat[index[world, i]] += array[world, i]``; no two threads have the same entry of ``flat``."""

    @wp.kernel(module=f"warp_spo_exchange_{T.__name__}", enable_backward=False)
    def kernel(index: wp.array2d[int], array: wp.array2d[T], flat_out: wp.array[T]):
        world, i = wp.tid()
        flat_out[index[world, i]] += array[world, i]

    return kernel


@functools.cache
def rotation_of(T) -> wp.Function:
    """Return the function for the quaternion of a pose [world, i, 7]."""
    quat = wp.types.quaternion(T)

    @wp.func
    def function(pose: wp.array3d[T], world: int, i: int):
        return quat(pose[world, i, 3], pose[world, i, 4], pose[world, i, 5], pose[world, i, 6])

    return function


@functools.cache
def turn_wrenches(T) -> wp.Kernel:
    """Rotate wrenches on free hinges, in place, from world axes into the axes of the hinges' parent anchors.

    ``hinge`` [n, 3] holds the first dof, the hinge, and the parent body or -1. ``anchor`` [world, hinge, 7] and
    ``poses`` [world, body, 7] are poses; ``tau`` [world, dof] holds the wrenches.
    """
    rotation, vec3 = rotation_of(T), wp.types.vector(3, T)

    @wp.kernel(module=f"warp_spo_exchange_{T.__name__}", enable_backward=False)
    def kernel(hinge: wp.array2d[int], anchor: wp.array3d[T], poses: wp.array3d[T], tau: wp.array2d[T]):
        world, i = wp.tid()
        dof, parent = hinge[i, 0], hinge[i, 2]
        q = wp.normalize(rotation(anchor, world, hinge[i, 1]))
        if parent >= 0:
            q = rotation(poses, world, parent) * q
        for half in range(2):
            at = dof + 3 * half
            v = wp.quat_rotate_inv(q, vec3(tau[world, at], tau[world, at + 1], tau[world, at + 2]))
            for c in range(3):
                tau[world, at + c] = v[c]

    return kernel


@functools.cache
def turn_gradients(T) -> wp.Kernel:
    """Take gradients back through :func:`turn_wrenches`; one thread a world, which adds in the order of the hinges.

    With w a force or a torque in world axes, R the axes of the parent anchor and g the gradient by R* w, the gradient
    by w is R g. If R turns with the parent body by the small angle t about world axes, R* w grows by R* (w x t), so
    that the gradient by t is (R g) x w. In the four numbers of the unit quaternion Q of the body it is 2 ((R g) x w) Q.

    ``tau_grad`` [world, dof] is changed in place, from R* w to w. ``poses_grad`` [world, body, 7], where it is given,
    is added to. The other arguments are those of :func:`turn_wrenches`.
    """
    quat, rotation, vec3 = wp.types.quaternion(T), rotation_of(T), wp.types.vector(3, T)

    @wp.kernel(module=f"warp_spo_exchange_{T.__name__}", enable_backward=False)
    def kernel(
        hinge: wp.array2d[int],
        anchor: wp.array3d[T],
        poses: wp.array3d[T],
        wrenches: wp.array2d[T],
        tau_grad: wp.array2d[T],
        poses_grad: wp.array3d[T],
    ):
        world = wp.tid()
        for i in range(hinge.shape[0]):
            dof, parent = hinge[i, 0], hinge[i, 2]
            turn = wp.normalize(rotation(anchor, world, hinge[i, 1]))
            if parent >= 0:
                turn = rotation(poses, world, parent) * turn
            about = vec3()
            for half in range(2):
                at = dof + 3 * half
                w = vec3(wrenches[world, at], wrenches[world, at + 1], wrenches[world, at + 2])
                g = wp.quat_rotate(turn, vec3(tau_grad[world, at], tau_grad[world, at + 1], tau_grad[world, at + 2]))
                about += wp.cross(g, w)
                for c in range(3):
                    tau_grad[world, at + c] = g[c]
            if parent >= 0 and poses_grad:
                two = T(2.0)
                four = quat(two * about[0], two * about[1], two * about[2], T(0.0)) * rotation(poses, world, parent)
                for c in range(4):
                    poses_grad[world, parent, 3 + c] += four[c]

    return kernel


KERNELS = (gather, scatter, scale, add, turn_wrenches, turn_gradients)
