"""Slots of contact points, which a list of contacts fills: by shape, in the order of the list."""

import functools

import warp as wp

from .newton_contacts import MOVING, in_world

EMPTY = wp.constant(2**31 - 1)  # a slot that no contact fills
AWAY = wp.constant(-1e3)  # depth of a point without contact [m], as warp_spo.scene.ground.AWAY; a test compares


@functools.cache
def fill_slots(_=None) -> wp.Kernel:
    """Write into the slots of each shape the numbers of its first contacts, ascending.

    One thread for each contact. A thread takes a slot's number if its own is smaller, and goes on to the next slot with
    the larger of the two: whatever the order of threads, the smallest numbers remain, sorted. Where a shape has more
    contacts than slots, ``excess`` of its world is set. Contacts of two shapes that move are left out.
    """
    empty, moving = EMPTY, wp.constant(MOVING)

    @wp.kernel(module="warp_spo_contact_slots", enable_backward=False)
    def kernel(
        count: wp.array[wp.int32],
        shape0: wp.array[wp.int32],
        shape1: wp.array[wp.int32],
        shape_role: wp.array[wp.int32],
        shape_slots: wp.array2d[wp.int32],
        slot_out: wp.array2d[wp.int32],
        excess_out: wp.array[wp.int32],
    ):
        i = wp.tid()
        if i >= count[0]:
            return
        a, b = shape0[i], shape1[i]
        if a < 0 or b < 0:
            return
        own = wp.where(shape_slots[a, 2] > 0, a, b)
        other = wp.where(shape_slots[a, 2] > 0, b, a)
        if shape_slots[own, 2] == 0 or shape_slots[other, 2] > 0 or shape_role[other] == moving:
            return
        world, first = shape_slots[own, 0], shape_slots[own, 1]
        carried = int(i)
        for place in range(shape_slots[own, 2]):
            before = wp.atomic_min(slot_out, world, first + place, carried)
            carried = wp.max(before, carried)
            if carried == empty:
                return
        excess_out[world] = 1

    return kernel


@functools.cache
def place_points(_=None) -> wp.Kernel:
    """Write place, normal and depth, and the materials, of the contact in each slot, [world, slot].

    The normal points from the other shape to the own one. Materials are means of both shapes', or the contact's.
    """
    empty, away = EMPTY, AWAY

    @wp.kernel(module="warp_spo_contact_slots", enable_backward=False)
    def kernel(
        slot: wp.array2d[wp.int32],
        slot_shape: wp.array2d[wp.int32],
        shape_body: wp.array[wp.int32],
        body_q: wp.array[wp.transform],
        shape0: wp.array[wp.int32],
        shape1: wp.array[wp.int32],
        point0: wp.array[wp.vec3],
        point1: wp.array[wp.vec3],
        margin0: wp.array[wp.float32],
        margin1: wp.array[wp.float32],
        normal: wp.array[wp.vec3],
        stiffness: wp.array[wp.float32],
        damping: wp.array[wp.float32],
        friction: wp.array[wp.float32],
        ke: wp.array[wp.float32],
        kd: wp.array[wp.float32],
        mu: wp.array[wp.float32],
        place_out: wp.array3d[wp.float32],
        stiffness_out: wp.array2d[wp.float32],
        damping_out: wp.array2d[wp.float32],
        friction_out: wp.array2d[wp.float32],
    ):
        world, s = wp.tid()
        i = slot[world, s]
        n, place, depth = wp.vec3(0.0, 0.0, 1.0), wp.vec3(0.0), float(away)
        own = slot_shape[world, s]
        other = own
        if i != empty:
            first = shape0[i] == own
            other = wp.where(first, shape1[i], shape0[i])
            n = wp.where(first, -normal[i], normal[i])
            here, there = wp.where(first, point0[i], point1[i]), wp.where(first, point1[i], point0[i])
            inside, outside = wp.where(first, margin0[i], margin1[i]), wp.where(first, margin1[i], margin0[i])
            pose, at = body_q[shape_body[own]], in_world(body_q, shape_body, other, there)
            touching = wp.transform_point(pose, here) - inside * n
            depth = wp.dot(n, at + outside * n - touching)
            place = wp.transform_point(wp.transform_inverse(pose), touching)
        for c in range(3):
            place_out[world, s, c] = place[c]
            place_out[world, s, 3 + c] = n[c]
        place_out[world, s, 6] = depth
        k, d, f = 0.5 * (ke[own] + ke[other]), 0.5 * (kd[own] + kd[other]), 0.5 * (mu[own] + mu[other])
        if i != empty and stiffness:
            k = wp.where(stiffness[i] > 0.0, stiffness[i], k)
            d = wp.where(damping[i] > 0.0, damping[i], d)
            f = wp.where(friction[i] > 0.0, f * friction[i], f)
        stiffness_out[world, s] = k
        damping_out[world, s] = d
        friction_out[world, s] = f

    return kernel


@functools.cache
def mark_worlds(_=None) -> wp.Kernel:
    """Set the word of worlds with an excess, or of all if the list lacks room, unless they hold a more severe one."""

    @wp.kernel(module="warp_spo_contact_slots", enable_backward=False)
    def kernel(
        excess: wp.array[wp.int32],
        count: wp.array[wp.int32],
        room: int,
        word: int,
        severity: wp.array[wp.int32],
        status_out: wp.array[wp.int32],
    ):
        world = wp.tid()
        if (excess[world] != 0 or count[0] > room) and severity[status_out[world]] < severity[word]:
            status_out[world] = word

    return kernel


KERNELS = (fill_slots, place_points, mark_worlds)
