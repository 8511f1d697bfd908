"""Contacts of a Newton model: materials of its shapes, and status words of worlds with contacts that are left out."""

import functools

import warp as wp

OK, UNSUPPORTED = wp.constant(0), wp.constant(10)  # as warp_spo.Status, which kernels cannot import; a test compares
STILL, GROUND, TOUCHING, MOVING = range(4)
"""Roles of shapes: stands still; is the ground; moves, and its contacts with the ground are computed; moves."""


@wp.func
def in_world(body_q: wp.array[wp.transform], shape_body: wp.array[wp.int32], shape: int, point: wp.vec3):
    """Return a point of a shape's body in the world's axes; that of a shape without a body, or of none, as it is."""
    if shape >= 0 and shape_body[shape] >= 0:
        return wp.transform_point(body_q[shape_body[shape]], point)
    return point


@functools.cache
def mark_contacts(_=None) -> wp.Kernel:
    """Set the word of every world that has a contact which is left out to UNSUPPORTED, but for a more severe one.

    Left out are those of a shape that moves, but for TOUCHING with GROUND, but for those with one of its ``partner``
    [shape, n], and but for those that are open at the poses ``body_q``, if they are given: lists hold what may touch
    soon. So are those of surfaces that move by themselves, as conveyors do. One thread for each slot of a list of
    contacts. ``count`` holds the number of contacts, which may exceed that of the slots: then the worlds of some are
    unknown, and all are marked if ``beyond`` is 1. So it is for a contact of shapes outside of all worlds, one of which
    moves. Threads that write one word write the same one.
    """
    still, ground, touching, moving = (wp.constant(role) for role in (STILL, GROUND, TOUCHING, MOVING))

    @wp.func
    def mark(world: int, severity: wp.array[wp.int32], status: wp.array[wp.int32]):
        if severity[status[world]] < severity[UNSUPPORTED]:
            status[world] = UNSUPPORTED

    @wp.kernel(module="warp_spo_contacts", enable_backward=False)
    def kernel(
        count: wp.array[wp.int32],
        shape0: wp.array[wp.int32],
        shape1: wp.array[wp.int32],
        shape_world: wp.array[wp.int32],
        shape_role: wp.array[wp.int32],
        shape_body: wp.array[wp.int32],
        partner: wp.array2d[wp.int32],
        body_q: wp.array[wp.transform],
        point0: wp.array[wp.vec3],
        point1: wp.array[wp.vec3],
        margin0: wp.array[wp.float32],
        margin1: wp.array[wp.float32],
        normal: wp.array[wp.vec3],
        surface_velocity: wp.array[wp.vec3],
        beyond: int,
        severity: wp.array[wp.int32],
        status_out: wp.array[wp.int32],
    ):
        i = wp.tid()
        if i >= count[0]:
            return
        world, most, least = int(-1), int(still), int(moving)
        for side in range(2):
            shape, role = wp.where(side == 0, shape0[i], shape1[i]), int(still)
            if shape >= 0:
                world = wp.max(world, shape_world[shape])
                role = shape_role[shape]
            most, least = wp.max(most, role), wp.min(least, role)
        moves = most >= touching and not (most == touching and least == ground)
        if moves and partner and shape0[i] >= 0:
            for k in range(partner.shape[1]):
                moves = moves and partner[shape0[i], k] != shape1[i]
        if most >= touching and surface_velocity:
            moves = moves or wp.length_sq(surface_velocity[i]) > 0.0
        if moves and body_q:
            at = in_world(body_q, shape_body, shape0[i], point0[i])
            there = in_world(body_q, shape_body, shape1[i], point1[i])
            moves = wp.dot(normal[i], there - at) <= margin0[i] + margin1[i]
        if beyond * count[0] > shape0.shape[0] or (moves and world < 0):
            for every in range(status_out.shape[0]):
                mark(every, severity, status_out)
        elif moves:
            mark(world, severity, status_out)

    return kernel


@functools.cache
def add_to_shapes(_=None) -> wp.Kernel:
    """Add half the gradients by means of shape and ground to those of the shapes and of the grounds.

    One thread for each shape, which reads the points that ``first`` and ``points`` list for it, in their order.
    """

    @wp.kernel(module="warp_spo_contacts", enable_backward=False)
    def kernel(
        shapes: wp.array[wp.int32],
        first: wp.array[wp.int32],
        points: wp.array[wp.int32],
        gradient: wp.array[wp.float32],
        gradient_out: wp.array[wp.float32],
    ):
        i = wp.tid()
        found = gradient_out[shapes[i]]
        for at in range(first[i], first[i + 1]):
            found += 0.5 * gradient[points[at]]
        gradient_out[shapes[i]] = found

    return kernel


@functools.cache
def keep_most_severe(_=None) -> wp.Kernel:
    """Set ``kept[world]`` to ``status[world]`` where that is more severe."""

    @wp.kernel(module="warp_spo_contacts", enable_backward=False)
    def kernel(status: wp.array[wp.int32], severity: wp.array[wp.int32], kept_out: wp.array[wp.int32]):
        world = wp.tid()
        word = status[world]
        if word != OK and severity[word] > severity[kept_out[world]]:
            kept_out[world] = word

    return kernel


@functools.cache
def clear(_=None) -> wp.Kernel:
    """Set ``status[world]`` to OK in the worlds where ``mask`` is True; without a mask, in all."""

    @wp.kernel(module="warp_spo_contacts", enable_backward=False)
    def kernel(mask: wp.array[wp.bool], status_out: wp.array[wp.int32]):
        world = wp.tid()
        if mask:
            if not mask[world]:
                return
        status_out[world] = OK

    return kernel


@functools.cache
def mean_materials(_=None) -> wp.Kernel:
    """Write the mean of a material of each point's shape and of its world's ground, [world, point]."""

    @wp.kernel(module="warp_spo_contacts", enable_backward=False)
    def kernel(
        rows: wp.array2d[wp.int32],
        ground: wp.array[wp.int32],
        material: wp.array[wp.float32],
        mean_out: wp.array2d[wp.float32],
    ):
        world, point = wp.tid()
        mean_out[world, point] = 0.5 * (material[rows[world, point]] + material[ground[world]])

    return kernel


@functools.cache
def mean_pairs(_=None) -> wp.Kernel:
    """Write the mean of a material of both shapes of each pair, [world, first + pair]."""

    @wp.kernel(module="warp_spo_contact_pairs", enable_backward=False)
    def kernel(
        one: wp.array2d[wp.int32],
        other: wp.array2d[wp.int32],
        material: wp.array[wp.float32],
        first: int,
        mean_out: wp.array2d[wp.float32],
    ):
        world, pair = wp.tid()
        mean_out[world, first + pair] = 0.5 * (material[one[world, pair]] + material[other[world, pair]])

    return kernel


KERNELS = (mark_contacts, keep_most_severe, clear, mean_materials, mean_pairs)
