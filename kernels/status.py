"""Whether forward dynamics of a world can be trusted: the digits that rounding leaves in D, and one word a world.

These kernels are launched only when a caller asks for the status (Jain, eq. 1). The estimate carries S(k), positive
semidefinite, with -eps S <= dP <= eps S for the error dP that rounding leaves in P(k). It obeys the recursion of P with
psi for phi,

    S(k) = sum over children phi [(I - G H) S (I - G H)* + L] phi* + L

driven by the diagonal matrix L, the size of the numbers that the node itself rounds. S is an estimate to first order,
up to constant factors of the order of one.
"""

import functools
import types
from typing import Any

import warp as wp

from .elementary import EPSILON
from .kinematics import SCREWS
from .topology import Topology

OK, PIVOT, NOT_FINITE, DIGITS, RANGE, NOT_SETTLED = range(6)
QUATERNION = 11
"""As warp_spo.Status, which kernels cannot import; a test compares."""
NORMAL = {
    wp.float32: (2.0**-126, 2.0**127),
    wp.float64: (2.0**-1022, 2.0**1023),
}  # the smallest normal number and the largest power of two


@functools.cache
def roundings(s) -> types.SimpleNamespace:
    """Return functions of the sizes of numbers: what rounds in a pivot, in its elimination, and on the way outward."""
    T, vec3, mat33 = s.T, s.vec3, s.mat33
    smallest = T(NORMAL[T][0] / EPSILON[T])  # below, products that carry the last digit of D are subnormal
    largest = T(NORMAL[T][1])

    @wp.func
    def absolute(a: mat33):
        return wp.matrix_from_rows(wp.abs(a[0]), wp.abs(a[1]), wp.abs(a[2]))

    @wp.func
    def root_of_diagonal(a: mat33):
        zero = T(0.0)
        return vec3(wp.sqrt(wp.max(a[0, 0], zero)), wp.sqrt(wp.max(a[1, 1], zero)), wp.sqrt(wp.max(a[2, 2], zero)))

    @wp.func
    def terms_of_pivot(J: mat33, C: mat33, m: mat33, w: vec3, v: vec3, alone: bool):
        """Return |H| |P| |H*|, and whether H is along one axis of the node frame.

        An oblique axis among several of a hinge, which is not ``alone``, has absolute errors.
        """
        w_a, v_a = wp.abs(w), wp.abs(v)
        n_a = absolute(J) * w_a + absolute(C) * v_a
        f_a = wp.transpose(absolute(C)) * w_a + absolute(m) * v_a
        entries = int(0)
        for c in range(3):
            entries += wp.where(w[c] == T(0.0), 0, 1) + wp.where(v[c] == T(0.0), 0, 1)
            if not alone and w[c] != T(0.0):
                w_a[c] = T(1.0)
        return wp.dot(w_a, n_a) + wp.dot(v_a, f_a), entries == 1

    @wp.func
    def lost_of(error: T, delta: T, size: T, along: bool, D: T):
        """Return the error of D in eps, or the word that says why there is none."""
        lost = (error + delta + wp.where(along, T(0.0), size)) / D
        whole = size + delta
        if whole > largest or (whole > T(0.0) and whole < smallest) or (D > T(0.0) and D < smallest):
            lost = T(-float(RANGE))
        elif wp.isnan(D) and not wp.isnan(whole):
            lost = T(-float(PIVOT))
        return lost

    @wp.func
    def rounding_of_rows(h: vec3, u: vec3, d: vec3, after: mat33, D: T, own: T):
        """Return the diagonal of L after the elimination of a hinge along a frame axis.

        It is ``own`` d^2 in the row of the hinge, and |P+| plus twice the subtracted term elsewhere.
        """
        rows = vec3()
        for i in range(3):
            rows[i] = wp.where(h[i] == T(0.0), wp.abs(after[i, i]) + T(2.0) * u[i] * u[i] / D, own * d[i] * d[i])
        return rows

    return types.SimpleNamespace(**locals())


@functools.cache
def error_rotation(s) -> wp.Function:
    """Return a function of R: |R| where an entry is exact, and |2 R|^1/2 where it has an absolute error of eps.

    Exact entries are zeros, and the sines of a rotation about one axis of a frame whose anchor is rotated by right
    angles.
    """
    T, mat33 = s.T, s.mat33

    @wp.func
    def bound(R: mat33, R_tree: mat33, screws: int):
        one_axis, right_angles = bool(False), bool(True)
        for i in range(3):
            for j in range(3):
                one_axis = one_axis or wp.abs(R[i, j]) == T(1.0)
                right_angles = right_angles and (R_tree[i, j] == T(0.0) or wp.abs(R_tree[i, j]) == T(1.0))
        a = mat33()
        for i in range(3):
            for j in range(3):
                r = wp.abs(R[i, j])
                exact = r == T(0.0) or (one_axis and right_angles and screws == 1 and R_tree[i, j] == T(0.0))
                a[i, j] = wp.where(exact, r, wp.sqrt(wp.min(T(2.0) * r, T(1.0))))
        return a

    return bound


@functools.cache
def lost_digits(s) -> wp.Kernel:
    """Inward, one level, after ``factor``: lost = (H S H* + |H| |P| |H*| + |Delta|) / D, the error of D in eps.

    Instead of the error, ``lost`` is -PIVOT where D is NaN because its pivot is not positive, -RANGE where D or one of
    its terms leaves the normal range of T, and NaN where D is NaN because of another node.

    The entries of L are the squares of ``d = diag(P)^1/2``, since |P(i, j)| <= d(i) d(j), so that small entries have
    small errors as long as nothing mixes them with large ones. A hinge along one axis of the node frame reads its entry
    of P without rounding and cancels its own row to exactly zero; an oblique hinge multiplies the error by the ratio of
    |H| |P| |H*| to D. A rotation about a frame axis keeps small entries small, any other rotation does not.
    """
    T, vec3, mat33 = s.T, s.vec3, s.mat33
    r, rotation = roundings(s), error_rotation(s)

    @wp.kernel(module=f"warp_spo_status_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        level: int,
        tree: wp.array3d[T],
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        rigid: wp.array3d[T],
        armature: wp.array2d[T],
        articulated: wp.array3d[T],
        gain: wp.array3d[T],
        pivot: wp.array2d[T],
        rounding_out: wp.array3d[T],  # S of P+ in the parent's frame
        lost_out: wp.array2d[T],
    ):
        i, world = wp.tid()
        node = topology.order[level + i]
        P = s.articulated(s.load_rigid(rigid, node, world))
        S = s.vec21()
        for c in range(topology.child_start[node], topology.child_start[node + 1]):
            P += s.load_articulated(articulated, topology.children[c], world)
            S += s.load_articulated(rounding_out, topology.children[c], world)
        J, C, m = s.J_of(P), s.C_of(P), s.m_of(P)
        S_J, S_C, S_m = s.J_of(S), s.C_of(S), s.m_of(S)
        terms = wp.sqrt(T(1 + topology.child_start[node + 1] - topology.child_start[node]))
        d_n, d_f = r.root_of_diagonal(J), r.root_of_diagonal(m)
        S_J += terms * wp.diag(wp.cw_mul(d_n, d_n))
        S_m += terms * wp.diag(wp.cw_mul(d_f, d_f))

        first = topology.qd_start[node]
        count = topology.dof_count[node]
        for e in range(count):
            dof = first + count - 1 - e
            h, U = s.load_motion(axis, dof, world), s.load_motion(gain, dof, world)
            w, v = h[0:3], h[3:6]
            n, f = U[0:3], U[3:6]
            D, delta = pivot[dof, world], wp.abs(armature[dof, world])
            size, along = r.terms_of_pivot(J, C, m, w, v, count == 1)

            n_S, f_S = S_J * w + S_C * v, wp.transpose(S_C) * w + S_m * v
            error = wp.dot(w, n_S) + wp.dot(v, f_S)
            lost_out[dof, world] = r.lost_of(error, delta, size, along, D)

            n_D, f_D = n / D, f / D
            d_n, d_f = r.root_of_diagonal(J), r.root_of_diagonal(m)
            S_J += wp.outer(n_D, error * n_D - n_S) - wp.outer(n_S, n_D)
            S_C += wp.outer(n_D, error * f_D - f_S) - wp.outer(n_S, f_D)
            S_m += wp.outer(f_D, error * f_D - f_S) - wp.outer(f_S, f_D)
            P = s.downdate(P, U, D)
            J, C, m = s.J_of(P), s.C_of(P), s.m_of(P)
            if along:
                own = T(0.0)
                if delta > T(0.0):  # the row keeps P Delta / D, the difference of two larger numbers
                    own = T(2.0)
                S_J += wp.diag(r.rounding_of_rows(w, n, d_n, J, D, own))
                S_m += wp.diag(r.rounding_of_rows(v, f, d_f, m, D, own))
            else:
                scale = T(1.0) + wp.sqrt(size / D)
                S_J += scale * scale * wp.diag(wp.cw_mul(d_n, d_n))
                S_m += scale * scale * wp.diag(wp.cw_mul(d_f, d_f))
        if topology.parent[node] >= 0:
            place = s.load_pose(pose, node, world)
            l = vec3(place[9], place[10], place[11])
            R_tree = s.rotation_of(s.load_pose(tree, node, world))
            R_a = rotation(s.rotation_of(place), R_tree, wp.where(topology.motion[node] == SCREWS, 1, 0))
            f_d = R_a * r.root_of_diagonal(m)
            n_d = R_a * r.root_of_diagonal(J) + r.absolute(s.skew(l)) * f_d
            S = s.articulated_to_parent(place, s.pack(S_J, S_C, S_m))
            S += s.pack(wp.diag(wp.cw_mul(n_d, n_d)), mat33(), wp.diag(wp.cw_mul(f_d, f_d)))
            s.store_articulated(rounding_out, node, world, S)

    return kernel


@wp.func
def node_values_finite(a: wp.array3d[Any], world: int):
    """Return whether all numbers [node, number, world] of a world are finite."""
    for i in range(a.shape[0]):
        for c in range(a.shape[1]):
            if not wp.isfinite(a[i, c, world]):
                return False
    return True


@wp.func
def inputs_finite(
    q: wp.array2d[Any],
    qd: wp.array2d[Any],
    tau: wp.array2d[Any],
    body_f: wp.array3d[Any],
    tree: wp.array3d[Any],
    com: wp.array3d[Any],
    rigid: wp.array3d[Any],
    armature: wp.array2d[Any],
    gravity: wp.array2d[Any],
    dofs: int,
    world: int,
):
    """Return whether all inputs of forward dynamics in a world are finite, values of bodies and hinges included."""
    fine = node_values_finite(tree, world) and node_values_finite(com, world) and node_values_finite(rigid, world)
    if gravity:
        for c in range(3):
            fine = fine and wp.isfinite(gravity[c, world])
    for i in range(q.shape[1]):
        fine = fine and wp.isfinite(q[world, i])
    for dof in range(dofs):
        fine = fine and wp.isfinite(armature[dof, world])
        if qd:
            fine = fine and wp.isfinite(qd[world, dof])
        if tau:
            fine = fine and wp.isfinite(tau[world, dof])
    if body_f:
        for body in range(body_f.shape[1]):
            for c in range(6):
                fine = fine and wp.isfinite(body_f[world, body, c])
    return fine


@functools.cache
def status_word(s) -> wp.Kernel:
    """Write the first word of NOT_FINITE, PIVOT, RANGE, DIGITS that applies to a world; one thread for each world.

    NOT_FINITE: an input is not finite. PIVOT: the sweeps found a pivot that is not positive, or the result is not
    finite and D may consist of rounding errors, because another form of the recursion refuses other pivots. RANGE: D
    left the normal range, the result overflows, or every entry of it is subnormal. DIGITS: D may have lost half of the
    digits of T, lost > 2 eps^-1/2; measured errors are 0.02 to 0.8 of ``lost``. Or forces of the dofs nearly cancel
    the others: the error of qdd is up to 5 eps |Mass^-1| |tau|, whose largest entry is 2 to 8 times that of |tau| / D.
    ``most_cancelled``: the largest |tau| / D over qdd of which half of the digits are left.
    """
    T = s.T
    most = T(2.0 * EPSILON[T] ** -0.5)
    none = T(0.1 / EPSILON[T])
    tiny = T(NORMAL[T][0])

    @wp.kernel(module=f"warp_spo_status_{T.__name__}", enable_backward=False)
    def kernel(
        q: wp.array2d[T],
        qd: wp.array2d[T],
        tau: wp.array2d[T],
        body_f: wp.array3d[T],
        tree: wp.array3d[T],
        com: wp.array3d[T],
        rigid: wp.array3d[T],
        armature: wp.array2d[T],
        gravity: wp.array2d[T],
        pivot: wp.array2d[T],
        most_cancelled: T,
        lost: wp.array2d[T],
        qdd: wp.array2d[T],
        status_out: wp.array[wp.int32],
    ):
        world = wp.tid()
        n = qdd.shape[1]
        positive, in_range, resolved = bool(True), bool(True), bool(True)
        overflow, hopeless = bool(False), bool(False)
        largest, cancelled = T(0.0), T(0.0)
        for dof in range(n):
            if tau:
                cancelled = wp.max(cancelled, wp.abs(tau[world, dof] / pivot[dof, world]))
            positive = positive and lost[dof, world] != T(-float(PIVOT))
            hopeless = hopeless or lost[dof, world] > none
            in_range = in_range and lost[dof, world] != T(-float(RANGE))
            resolved = resolved and not lost[dof, world] > most
            overflow = overflow or not wp.isfinite(qdd[world, dof])
            largest = wp.max(largest, wp.abs(qdd[world, dof]))
        word = int(OK)
        if not inputs_finite(q, qd, tau, body_f, tree, com, rigid, armature, gravity, n, world):
            word = int(NOT_FINITE)
        elif not positive or (overflow and hopeless):
            word = int(PIVOT)
        elif overflow or not in_range or (largest > T(0.0) and largest < tiny):
            word = int(RANGE)
        elif not resolved or cancelled > most_cancelled * largest:
            word = int(DIGITS)
        status_out[world] = word

    return kernel


@functools.cache
def mark_unsettled(T) -> wp.Kernel:
    """Set NOT_SETTLED in worlds whose final kick changed a rate by more than ``share`` of the largest rate.

    Worlds with another status keep it. ``found`` are the rates after the last iteration, ``rates`` those after the
    step, ``kick`` is half of what velocity terms add to ``found``; the largest rate is that of ``found`` without both
    kicks. All are [world, dof].
    """

    @wp.kernel(module=f"warp_spo_unsettled_{T.__name__}", enable_backward=False)
    def kernel(
        found: wp.array2d[T],
        kick: wp.array2d[T],
        rates: wp.array2d[T],
        share: T,
        status_out: wp.array[wp.int32],
    ):
        world = wp.tid()
        change, largest, lost = T(0.0), T(0.0), T(0.0)
        for dof in range(rates.shape[1]):
            difference = wp.abs(rates[world, dof] - found[world, dof])
            change, lost = wp.max(change, difference), lost + T(0.0) * difference
            largest = wp.max(largest, wp.abs(found[world, dof] - T(2.0) * kick[world, dof]))
        if not change + lost <= share * largest and status_out[world] == OK:
            status_out[world] = NOT_SETTLED

    return kernel


@functools.cache
def mark_correction(T) -> wp.Kernel:
    """Set DIGITS in worlds whose word is OK and where a ``correction`` of qdd exceeds ``share`` of the largest entry.

    Both are [world, dof]. A correction that is NaN exceeds every share.
    """

    @wp.kernel(module=f"warp_spo_correction_{T.__name__}", enable_backward=False)
    def kernel(qdd: wp.array2d[T], correction: wp.array2d[T], share: T, status_out: wp.array[wp.int32]):
        world = wp.tid()
        change, largest, lost = T(0.0), T(0.0), T(0.0)
        for dof in range(qdd.shape[1]):
            size = wp.abs(correction[world, dof])
            change, lost = wp.max(change, size), lost + T(0.0) * size
            largest = wp.max(largest, wp.abs(qdd[world, dof]))
        if not change + lost <= share * largest and status_out[world] == OK:
            status_out[world] = DIGITS

    return kernel


KERNELS = (lost_digits, status_word)  # at node granularity; the others take a scalar type and have their own modules
