"""Points that two convex shapes share: segments with radii, spheres and boxes, boxes and boxes by clipped faces.

A thread works on one pair in one world. The array of touches is [entry, world]. A pair has a header, the origin of the
second body from that of the first, and then POINT entries for each of its points: place from the first body's origin,
normal towards the first body, depth; all in inertial axes. Points that are not there are AWAY deep.
"""

import functools

import warp as wp

HEADER, POINT, AWAY = 3, 7, -1e3
ENTRIES = 11  # of a shape: its pose in the body, half its sizes, its radius
LEAD = 0.05  # share of the smallest half size by which the second box must be farther away to give the common face


@functools.cache
def find_touches(T) -> wp.Kernel:
    """Write the touches of all pairs.

    Inputs are the poses of frames [world, frame, 7]; for each pair (frame, frame, kind, kind, first entry of its
    touches), with 0 for shapes with a radius and 1 for boxes; and the shapes [2 pair, ENTRIES].
    """
    vec, quat, mat = wp.types.vector(3, T), wp.types.quaternion(T), wp.types.matrix((3, 3), T)
    polygon = wp.types.matrix((8, 3), T)

    @wp.struct
    class Placed:
        at: vec
        turn: mat
        size: vec
        radius: T

    @wp.struct
    class Touch:
        at: vec
        normal: vec
        depth: T

    @wp.struct
    class Face:
        apart: T
        axis: int
        sign: T

    @wp.func
    def turn_of(x: T, y: T, z: T, w: T):
        return wp.quat_to_matrix(wp.normalize(quat(x, y, z, w)))

    @wp.func
    def place(origin: vec, turn: mat, shapes: wp.array2d[T], row: int):
        found = Placed()
        local = vec(shapes[row, 0], shapes[row, 1], shapes[row, 2])
        found.at = origin + turn * local
        found.turn = turn * turn_of(shapes[row, 3], shapes[row, 4], shapes[row, 5], shapes[row, 6])
        found.size = vec(shapes[row, 7], shapes[row, 8], shapes[row, 9])
        found.radius = shapes[row, 10]
        return found

    @wp.func
    def rounds(a: Placed, b: Placed):
        """Ericson 2005, section 5.1.9."""
        one, zero = T(1.0), T(0.0)
        u = a.turn * vec(zero, zero, T(2.0) * a.size[2])
        v = b.turn * vec(zero, zero, T(2.0) * b.size[2])
        p, q = a.at - T(0.5) * u, b.at - T(0.5) * v
        w = p - q
        uu, vv, uv, uw, vw = wp.dot(u, u), wp.dot(v, v), wp.dot(u, v), wp.dot(u, w), wp.dot(v, w)
        s = T(0.0)
        t = T(0.0)
        if uu == zero:
            if vv > zero:
                t = wp.clamp(vw / vv, zero, one)
        elif vv == zero:
            s = wp.clamp(-uw / uu, zero, one)
        else:
            across = uu * vv - uv * uv
            s = T(0.5)
            if across > T(1.0e-6) * uu * vv:
                s = wp.clamp((uv * vw - uw * vv) / across, zero, one)
            t = (uv * s + vw) / vv
            if t < zero or t > one:
                t = wp.clamp(t, zero, one)
                s = wp.clamp((uv * t - uw) / uu, zero, one)
        x, y = p + s * u, q + t * v
        distance = wp.length(x - y)
        found = Touch()
        found.normal = vec(zero, zero, one)
        if distance > zero:
            found.normal = (x - y) / distance
        found.at = T(0.5) * (x - a.radius * found.normal + y + b.radius * found.normal)
        found.depth = a.radius + b.radius - distance
        return found

    @wp.func
    def ball_in_box(ball: Placed, box: Placed):
        """The normal leads out of the box."""
        local = wp.transpose(box.turn) * (ball.at - box.at)
        inside = vec(
            wp.clamp(local[0], -box.size[0], box.size[0]),
            wp.clamp(local[1], -box.size[1], box.size[1]),
            wp.clamp(local[2], -box.size[2], box.size[2]),
        )
        distance = wp.length(local - inside)
        normal = vec(T(0.0), T(0.0), T(0.0))
        if distance > T(0.0):
            normal = (local - inside) / distance
        else:
            axis = int(0)
            for i in range(1, 3):
                if box.size[i] - wp.abs(local[i]) < box.size[axis] - wp.abs(local[axis]):
                    axis = i
            distance = wp.abs(local[axis]) - box.size[axis]
            normal[axis] = wp.where(local[axis] >= T(0.0), T(1.0), T(-1.0))
        found = Touch()
        found.depth = ball.radius - distance
        found.normal = box.turn * normal
        found.at = box.at + box.turn * (local - (distance + T(0.5) * found.depth) * normal)
        return found

    @wp.func
    def farthest(one: Placed, other: Placed):
        """The face of a box from which another box is farthest."""
        offset = wp.transpose(one.turn) * (other.at - one.at)
        across = wp.transpose(one.turn) * other.turn
        found = Face()
        found.axis = int(-1)
        for i in range(3):
            reach = T(0.0)
            for j in range(3):
                reach += wp.abs(across[i, j]) * other.size[j]
            apart = wp.abs(offset[i]) - one.size[i] - reach
            if found.axis < 0 or apart > found.apart:
                found.apart = apart
                found.axis = i
                found.sign = wp.where(offset[i] >= T(0.0), T(1.0), T(-1.0))
        return found

    @wp.func
    def axis_of(turn: mat, i: int):
        return vec(turn[0, i], turn[1, i], turn[2, i])

    @wp.func
    def write(out: wp.array2d[T], entry: int, world: int, at: vec, normal: vec, depth: T):
        for c in range(3):
            out[entry + c, world] = at[c]
            out[entry + 3 + c, world] = normal[c]
        out[entry + 6, world] = depth

    @wp.func
    def faces(a: Placed, b: Placed, out: wp.array2d[T], entry: int, world: int):
        """A face of one box, clipped by the sides of the nearest face of the other."""
        first, second = farthest(a, b), farthest(b, a)
        swap = second.apart > first.apart + T(LEAD) * wp.min(wp.min(a.size), wp.min(b.size))
        here, there, face = a, b, first
        if swap:
            here = b
            there = a
            face = second
        normal = face.sign * axis_of(here.turn, face.axis)
        toward = wp.transpose(there.turn) * normal
        side = int(0)
        for i in range(1, 3):
            if wp.abs(toward[i]) > wp.abs(toward[side]):
                side = i
        j, k = (side + 1) % 3, (side + 2) % 3
        u, v = there.size[j] * axis_of(there.turn, j), there.size[k] * axis_of(there.turn, k)
        middle = there.at - wp.sign(toward[side]) * there.size[side] * axis_of(there.turn, side)
        corners = polygon()
        corners[0] = middle + u + v
        corners[1] = middle - u + v
        corners[2] = middle - u - v
        corners[3] = middle + u - v
        count = int(4)
        for cut in range(4):
            i = (face.axis + 1 + cut / 2) % 3
            across = wp.where(cut % 2 == 0, T(1.0), T(-1.0)) * axis_of(here.turn, i)
            limit = here.size[i] + wp.dot(across, here.at)
            kept = polygon()
            number = int(0)
            for at in range(count):
                p, q = corners[at], corners[(at + 1) % count]
                x, y = wp.dot(across, p) - limit, wp.dot(across, q) - limit
                if x <= T(0.0) and number < 8:
                    kept[number] = p
                    number += 1
                if ((x < T(0.0) and y > T(0.0)) or (y < T(0.0) and x > T(0.0))) and number < 8:
                    kept[number] = p + (x / (x - y)) * (q - p)
                    number += 1
            corners = kept
            count = number
        for at in range(8):
            depth = T(AWAY)
            corner = vec(T(0.0), T(0.0), T(0.0))
            if at < count:
                corner = corners[at]
                depth = here.size[face.axis] - wp.dot(normal, corner - here.at)
                corner = corner + T(0.5) * depth * normal
            write(out, entry + POINT * at, world, corner, wp.where(swap, normal, -normal), depth)

    @wp.kernel(module=f"warp_spo_touches_{T.__name__}", enable_backward=False)
    def kernel(poses: wp.array3d[T], pairs: wp.array2d[int], shapes: wp.array2d[T], touches_out: wp.array2d[T]):
        pair, world = wp.tid()
        i, j, header = pairs[pair, 0], pairs[pair, 1], pairs[pair, 4]
        origin = vec(poses[world, i, 0], poses[world, i, 1], poses[world, i, 2])
        between = vec(poses[world, j, 0], poses[world, j, 1], poses[world, j, 2]) - origin
        turn = turn_of(poses[world, i, 3], poses[world, i, 4], poses[world, i, 5], poses[world, i, 6])
        a = place(vec(T(0.0), T(0.0), T(0.0)), turn, shapes, 2 * pair)
        turn = turn_of(poses[world, j, 3], poses[world, j, 4], poses[world, j, 5], poses[world, j, 6])
        b = place(between, turn, shapes, 2 * pair + 1)
        for c in range(3):
            touches_out[header + c, world] = between[c]
        entry = header + HEADER
        if pairs[pair, 2] == 1 and pairs[pair, 3] == 1:
            faces(a, b, touches_out, entry, world)
        else:
            touch = rounds(a, b)
            if pairs[pair, 2] == 1:
                touch = ball_in_box(b, a)
                touch.normal = -touch.normal
            elif pairs[pair, 3] == 1:
                touch = ball_in_box(a, b)
            write(touches_out, entry, world, touch.at, touch.normal, touch.depth)

    return kernel


KERNELS = (find_touches,)
