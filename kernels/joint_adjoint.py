"""The way back through the passes of :mod:`.joint_space`: gradients by all that they read, from those by the rates.

The passes run once more; the laws, factors and changes of each are kept. Then, from the last pass to the first one,
with y the gradient by the change x of a pass, A lambda = y is solved with its own factor, A being symmetric, and

    lambda . (R - h S x) + (J lambda) . (f - h G J x)

is differentiated by the laws R, S, f, G, by J, and through them by what the pass before left. Which points are closed,
which laws are at their bounds, and which side of each switch holds is that of the passes. Mass matrix and bias force
enter as lambda . (M x + h bias), whose gradient the caller takes, from ``solved`` and ``gains``.

A warp takes a world, one thread on the CPU; each sum is formed by one lane in a fixed order.
"""

from __future__ import annotations

import functools

import warp as wp

from . import joint_passes, native
from .joint_space import ARGUMENTS as SOLVED
from .joint_space import (
    DOF_FIELDS,
    SLOT_FIELDS,
    WARP,
    Sizes,
    native_text,
    world_bytes,
)

READ = [name for name, _ in SOLVED].index("passes") + 1  # arguments of a step that it reads
ARGUMENTS = [
    *SOLVED[:READ], ("cotangent", 2),
    ("work", 2), ("solved", 2), ("gains", 2), ("tau_bar", 2), ("q_bar", 2), ("qd_bar", 2), ("target_q_bar", 2),
    ("target_qd_bar", 2), ("screws_bar", 2), ("touches_bar", 2), ("surfaces_bar", 2), ("motors_bar", 2),
    ("stiffness_bar", 2), ("damping_bar", 2), ("friction_bar", 2),
]  # fmt: skip
"""Names and numbers of axes: what a step reads, the gradient by its rates [world, dof], memory of :func:`work_size`.

``solved``, ``gains`` [world, pass * dof]: -h lambda, and x / h. The others are gradients. Those by ``q`` and targets
are the part that the laws of the joints have, that by ``qd`` all but what bias force and surfaces have. By the values
of contacts [world, contact] they are whole for pairs, and lack what push and damping of surfaces have.
"""

BEFORE = r"""
enum { K_DOF = 4 * TILES, K_SLOT = K_DOF + DOF_FIELDS * N, K_SHARE = K_SLOT + SLOT_FIELDS * S, KEPT = K_SHARE + LAWS };
REAL* const history = work.data + world * work.shape[1];
"""
AFTER = r"""
    EACH (i, K_DOF) history[(long long)number * KEPT + i] = s[AT_A + i];
    EACH (i, DOF_FIELDS * N) history[(long long)number * KEPT + K_DOF + i] = dof[i];
    EACH (i, SLOT_FIELDS * slots) history[(long long)number * KEPT + K_SLOT + i] = slot[i];
    EACH (i, LAWS) history[(long long)number * KEPT + K_SHARE + i] = shares[i];
    SYNC
"""
BACK = r"""
SYNC
// -- back through the passes; gradients by each quantity end with _b
REAL *const x_b = history + (long long)pass_count * KEPT, *const v0_b = x_b + N, *const drive_b = v0_b + N,
    *const dry_b = drive_b + N, *const lambda = dry_b + N, *const share_b = lambda + N,
    *const across_b = share_b + LAWS, *const spring_b = across_b + S, *const kd_b = spring_b + S,
    *const mu_b = kd_b + S, *const u_b = mu_b + S, *const u0_b = u_b + 3 * S, *const J_b = u0_b + 3 * S,
    *const bars_end = J_b + 6 * MB * S;
EACH (i, bars_end - x_b) x_b[i] = 0;
EACH (i, q_bar.shape[1]) q_bar.data[world * q_bar.shape[1] + i] = target_q_bar.data[world * q_bar.shape[1] + i] = 0;
EACH (i, DOFS) tau_bar.data[world * DOFS + i] = target_qd_bar.data[world * DOFS + i] = 0;
EACH (i, NEAR * MOST * POINT) touches_bar.data[world * (NEAR * MOST * POINT) + i] = 0;
EACH (i, LAW * LAWS) motors_bar.data[world * motors_bar.shape[1] + i] = 0;
REAL* const motor_b = motors_bar.data + world * motors_bar.shape[1];
SYNC
EACH (i, N) {
    const int own = table[T_DOF_OF + i];
    x_b[i] = v0_b[i] = own < 0 ? 0 : cotangent.data[world * DOFS + own];
    lambda[i] = x_b[i];
}
SYNC
LOOP
for (int number = pass_count - 1; number >= 0; --number) {
    const bool first = number == 0;
    const REAL *const kept = history + (long long)number * KEPT, *const old = kept - KEPT;
    const REAL *const now_dof = kept + K_DOF, *const now_slot = kept + K_SLOT, *const now_x = now_dof + X * N;
    const REAL *const old_dof = old + K_DOF, *const old_slot = old + K_SLOT, *const old_x = old_dof + X * N;
    // -- lambda
    LOOP
    for (int j = 0; j < NB; ++j) {
        const unsigned short* const rows = list + start[j] + 1;
        REAL y0 = lambda[2 * j], y1 = lambda[2 * j + 1];
        joint_space::divide(now_dof[I0 * N + j], now_dof[L10 * N + j], now_dof[I1 * N + j], y0, y1);
        EACH (a, start[j + 1] - start[j] - 2) {
            const int row = rows[a] >> 8;
            const REAL* const x = kept + 4 * joint_space::tile(row, j);
            lambda[2 * row] = FMA(-x[1], y1, FMA(-x[0], y0, lambda[2 * row]));
            lambda[2 * row + 1] = FMA(-x[3], y1, FMA(-x[2], y0, lambda[2 * row + 1]));
        }
        SYNC
    }
    SYNC
    LOOP
    for (int j = NB - 1; j >= 0; --j) {
        REAL x0 = lambda[2 * j], x1 = lambda[2 * j + 1];
        joint_space::divide(now_dof[I0 * N + j], now_dof[L10 * N + j], now_dof[I1 * N + j], x0, x1);
        EACH (k, j) {
            const REAL* const x = kept + 4 * joint_space::tile(j, k);
            lambda[2 * k] = FMA(-x[2], x1, FMA(-x[0], x0, lambda[2 * k]));
            lambda[2 * k + 1] = FMA(-x[3], x1, FMA(-x[1], x0, lambda[2 * k + 1]));
        }
        SYNC
        if (lane == 0) {
            lambda[2 * j] = x0;
            lambda[2 * j + 1] = x1;
        }
    }
    SYNC
    // -- points
    EACH (at, slots) {
        const int pair = joint_space::pair_of(nears, slot_of[at]);
        const int* const row = table + T_COUPLE + (1 + MB) * table[T_PAIR + 2 * pair];
        const REAL* const value = pair_value + PV * pair;
        const REAL *const now = now_slot + SLOT_FIELDS * at, *const earlier = old_slot + SLOT_FIELDS * at;
        const REAL kd = now[KD], mu = value[P_FRICTION], spring = now[PUSH];
        REAL u0[3], u[3], damp[3], pushed[3] = {0, 0, 0}, moved[3] = {0, 0, 0};
        for (int r = 0; r < 3; ++r) {
            u[r] = u0[r] = now[U0 + r];
            damp[r] = now[r ? CT : CN];
        }
        for (int c = 0; c < row[0]; ++c)
            for (int r = 0; r < 3; ++r)
                for (int d = 0; d < 2; ++d) {
                    const int i = 2 * (row[1 + c] & 255) + d;
                    const REAL each = J[(at * MB + c) * 6 + 2 * r + d];
                    pushed[r] = FMA(each, lambda[i], pushed[r]);
                    moved[r] = FMA(each, now_x[i], moved[r]);
                    if (!first) u[r] = FMA(each, old_x[i], u[r]);
                }
        // the law of this pass: along, across and force by the velocity that the pass before found
        const int flags = (int)now[FLAG], were = first ? 0 : (int)earlier[FLAG];
        const bool closed = flags & 1, candidate = flags & 2, shut = were & 1;
        const REAL across = now[ACROSS], push = FMA(-kd, u[0], spring);
        const REAL slip = sqrt(FMA(u[1], u[1], u[2] * u[2]));
        const bool pushes = (first ? candidate : shut) && push > 0;
        const REAL fn = pushes ? push : 0, before = first ? 0 : earlier[ACROSS];
        const REAL over = first ? 0 : joint_space::positive(FMA(before, slip, -(mu * fn)));
        const REAL w = FMA(h * value[P_WEIGHT], over, slip);
        const REAL squared = FMA(w, w, value[P_EPS] * value[P_EPS]), rigid = (REAL)RIGID / (h * value[P_WEIGHT]);
        const bool capped = mu * fn / sqrt(squared) > rigid;
        REAL all_across_b = across_b[at] - h * (FMA(pushed[1], moved[1], pushed[2] * moved[2])
            + FMA(pushed[1], u0[1], pushed[2] * u0[2]));
        REAL by_u[3] = {0, 0, 0}, push_b = 0, before_b = 0, slip_b = 0;
        for (int r = 1; r < 3; ++r) u0_b[3 * at + r] -= h * across * pushed[r];
        if (closed) {
            kd_b[at] -= h * pushed[0] * (moved[0] + u0[0]);
            spring_b[at] += h * pushed[0];
            u0_b[3 * at] -= h * kd * pushed[0];
        }
        if (!capped) {
            const REAL root = sqrt(squared), w_b = -all_across_b * across * w / squared;
            REAL fn_b = all_across_b * mu / root;
            mu_b[at] += all_across_b * fn / root;
            slip_b = w_b;
            if (over > 0) {
                const REAL over_b = h * value[P_WEIGHT] * w_b;
                before_b = over_b * slip;
                slip_b += over_b * before;
                mu_b[at] -= over_b * fn;
                fn_b -= over_b * mu;
            }
            push_b = pushes ? fn_b : 0;
        }
        across_b[at] = before_b;
        spring_b[at] += push_b;
        kd_b[at] -= push_b * u[0];
        by_u[0] = -kd * push_b;
        for (int r = 1; r < 3; ++r) by_u[r] = slip > 0 ? slip_b * u[r] / slip : 0;
        for (int r = 0; r < 3; ++r) {
            u0_b[3 * at + r] += by_u[r];
            u_b[3 * at + r] = by_u[r];
        }
        for (int c = 0; c < row[0]; ++c)
            for (int r = 0; r < 3; ++r)
                for (int d = 0; d < 2; ++d) {
                    const int i = 2 * (row[1 + c] & 255) + d;
                    const REAL load = FMA(-damp[r], moved[r], now[F + r]);
                    REAL more = FMA(load, lambda[i], -(damp[r] * pushed[r]) * now_x[i]);
                    if (!first) more = FMA(by_u[r], old_x[i], more);
                    J_b[(at * MB + c) * 6 + 2 * r + d] += more;
                }
    }
    // -- dofs
    EACH (i, N) {
        const int own = table[T_DOF_OF + i];
        if (own < 0) {
            x_b[i] = 0;
            continue;
        }
        const REAL* const value = dof_value + DV * own;
        const int coordinate = table[T_COORDINATE + own];
        const REAL before = now_dof[V0 * N + i], moved = now_x[i], v = first ? before : before + old_x[i];
        const long long here = world * DOFS + own, there = world * q.shape[1] + coordinate;
        const REAL force_b = h * lambda[i], resistance_b = -h * lambda[i] * (moved + before);
        REAL v_b = 0, before_b = -now_dof[D * N + i] * lambda[i], at_b = 0;
        solved.data[world * solved.shape[1] + number * DOFS + own] = -h * lambda[i];
        gains.data[world * gains.shape[1] + number * DOFS + own] = moved / h;
        tau_bar.data[here] += force_b;
        const REAL at = coordinate < 0 ? 0 : q.data[there], effort = value[C_EFFORT];
        const REAL most = effort > 0 ? FMA(h, value[C_KE], value[C_KD]) : 0;
        if (most > 0) {  // drive
            REAL aim = value[C_KD] * target_qd.data[here];
            if (coordinate >= 0) aim += value[C_KE] * (target_q.data[there] - at);
            aim /= most;
            const REAL apart = joint_space::size_of(v - aim), earlier = first ? 0 : old_dof[DRIVE * N + i];
            const REAL beyond = first ? 0 : joint_space::positive(earlier * apart - effort);
            const REAL w = FMA(h * value[C_WEIGHT], beyond, apart), drive = now_dof[DRIVE * N + i];
            const REAL by_drive = FMA(aim, force_b, resistance_b + drive_b[i]);
            REAL aim_b = drive * force_b, apart_b = most * w > effort ? -by_drive * drive / w : 0;
            const REAL beyond_b = h * value[C_WEIGHT] * apart_b;
            drive_b[i] = beyond > 0 ? beyond_b * apart : 0;
            apart_b += beyond > 0 ? beyond_b * earlier : 0;
            const REAL way = v < aim ? -apart_b : apart_b;
            v_b += way;
            aim_b -= way;
            target_qd_bar.data[here] += value[C_KD] / most * aim_b;
            if (coordinate >= 0) {
                target_q_bar.data[there] += value[C_KE] / most * aim_b;
                at_b -= value[C_KE] / most * aim_b;
            }
        }
        LOOP
        for (int l = LAWS ? table[T_LAW + own] : 0; l < (LAWS ? table[T_LAW + own + 1] : 0); ++l) {
            const REAL* const law = motor + LAW * l;
            REAL* const law_b = motor_b + LAW * l;
            const REAL line = FMA(-law[1], v - before, law[0]), least = law[2], greatest = law[3], scale = law[4];
            const bool low = least > (REAL)-1e29, high = greatest < (REAL)1e29;
            const REAL part_b = FMA(law[1], resistance_b, FMA(law[1], before, law[0]) * force_b);
            REAL line_b = 0, part = scale;
            if (low && high) {
                const REAL size = joint_space::size_of(line), way = line < 0 ? -1 : 1;
                const int bounded = line > 0 ? 3 : 2;
                const REAL bound = joint_space::positive(line > 0 ? greatest : -least);
                const REAL earlier = first ? 0 : old[K_SHARE + l];
                const REAL beyond = first ? 0 : joint_space::positive(FMA(earlier, size, -bound));
                const REAL more = scale * law[1] * (h * value[C_WEIGHT] * beyond), share = kept[K_SHARE + l];
                const bool outside = (least > 0 || greatest < 0) && (line > 0 ? greatest : -least) < 0;
                const REAL by_share = share_b[l] + (outside ? 0 : scale * part_b);
                part = outside ? 0 : scale * share;
                law_b[4] += outside ? 0 : share * part_b;
                REAL bound_b = 0;
                share_b[l] = 0;
                if (bound < size + more) {
                    const REAL size_b = -by_share * share / (size + more);
                    bound_b = bound > 0 ? by_share / (size + more) : 0;
                    line_b += way * size_b;
                    law_b[4] += law[1] * (h * value[C_WEIGHT] * beyond) * size_b;
                    law_b[1] += scale * (h * value[C_WEIGHT] * beyond) * size_b;
                    const REAL beyond_b = scale * law[1] * h * value[C_WEIGHT] * size_b;
                    if (beyond > 0) {
                        share_b[l] = beyond_b * size;
                        line_b += way * beyond_b * earlier;
                        bound_b -= bound > 0 ? beyond_b : 0;
                    }
                }
                law_b[bounded] += line > 0 ? bound_b : -bound_b;
                if (outside) {
                    const bool under = line < least, above = line > greatest;
                    law_b[4] += force_b * (under ? least : above ? greatest : line);
                    if (under || above) law_b[under ? 2 : 3] += scale * force_b;
                    else line_b += scale * force_b;
                }
            } else if ((low && line < least) || (high && line > greatest)) {
                law_b[4] += force_b * (low ? least : greatest);
                law_b[low ? 2 : 3] += scale * force_b;
                part = 0;
            } else law_b[4] += part_b;
            law_b[1] += FMA(part, resistance_b, part * before * force_b) - (v - before) * line_b;
            law_b[0] += FMA(part, force_b, line_b);
            before_b += FMA(part * law[1], force_b, law[1] * line_b);
            v_b -= law[1] * line_b;
        }
        if (coordinate >= 0) at_b -= value[C_STIFFNESS] * force_b;
        if (value[C_DRY] > 0) {
            const REAL speed = joint_space::size_of(v), earlier = first ? 0 : old_dof[DRY * N + i];
            const REAL beyond = first ? 0 : joint_space::positive(FMA(earlier, speed, -value[C_DRY]));
            const REAL w = FMA(h * value[C_WEIGHT], beyond, speed);
            const REAL w_b = -(resistance_b + dry_b[i]) * now_dof[DRY * N + i] * w / FMA(w, w, (REAL)1e-8);
            REAL speed_b = w_b;
            dry_b[i] = 0;
            if (beyond > 0) {
                dry_b[i] = h * value[C_WEIGHT] * w_b * speed;
                speed_b += h * value[C_WEIGHT] * w_b * earlier;
            }
            v_b += v < 0 ? -speed_b : speed_b;
        }
        if (coordinate >= 0) {
            const int on = (int)now_dof[LIMIT * N + i];
            for (int side = 0; side < 2; ++side) {
                if (!(on >> side & 1)) continue;
                const REAL way = side ? -1 : 1, depth = way * (value[C_LOWER + side] - at), inward = way * v;
                const REAL k = value[C_LIMIT_KE], d = FMA(h, k, depth > 0 ? value[C_LIMIT_KD] : 0);
                const bool held = first ? FMA(h, joint_space::positive(-inward), depth) > 0
                                        : FMA(k, depth, -(d * inward)) > 0;
                at_b -= held || depth > 0 ? k * force_b : 0;
            }
            q_bar.data[there] += at_b;
        }
        v0_b[i] += before_b + v_b;
        x_b[i] = v_b;
    }
    SYNC
    // -- by the velocities of points: to the pass before; from the first one, to the rates before the step
    REAL *const to = first ? v0_b : x_b, *const by = first ? u0_b : u_b;
    EACH (j, NB) {
        REAL sum[2] = {0, 0};
        for (int w = 0; w < SLOT_WORDS; ++w)
            for (unsigned int left = touching[j * SLOT_WORDS + w]; left; left &= left - 1) {
                const int at = 32 * w + joint_space::first_of(left), c = joint_space::rank(slot_mask + at * WORDS, j);
                joint_space::push(J + (at * MB + c) * 6, by + 3 * at, sum);
            }
        for (int d = 0; d < 2; ++d) to[2 * j + d] += sum[d];
    }
    SYNC
    EACH (i, N) lambda[i] = x_b[i];
    SYNC
}
"""
RESULTS = r"""
// -- gradients by points: by place, normal and depth; of a pair its law, too
EACH (i, N) {
    const int own = table[T_DOF_OF + i];
    if (own >= 0) qd_bar.data[world * DOFS + own] = v0_b[i];
}
EACH (at, slots) {
    const int where = slot_of[at], pair = joint_space::pair_of(nears, where);
    const int* const row = table + T_COUPLE + (1 + MB) * table[T_PAIR + 2 * pair];
    const REAL* const found = joint_space::point_of(touch, surface, where);
    const bool ground = pair >= PAIRS;
    REAL* const to = ground ? surfaces_bar.data + world * surfaces_bar.shape[1] + (pair - PAIRS) * SURFACE
                            : touches_bar.data + world * (NEAR * MOST * POINT) + where * POINT;
    for (int c = 0; c < row[0]; ++c)
        for (int r = 0; r < 3; ++r)
            for (int d = 0; d < 2; ++d)
                J_b[(at * MB + c) * 6 + 2 * r + d] += u0_b[3 * at + r] * dof[V0 * N + 2 * (row[1 + c] & 255) + d];
    REAL axes[9], by_axes[9] = {0, 0, 0, 0, 0, 0, 0, 0, 0}, place[3] = {0, 0, 0}, tilt[3] = {0, 0, 0};
    for (int r = 0; r < 3; ++r) axes[r] = found[3 + r];
    joint_space::tangents(axes, axes + 3, axes + 6);
    for (int c = 0; c < row[0]; ++c)
        for (int d = 0; d < 2; ++d) {
            const int own = table[T_DOF_OF + 2 * (row[1 + c] & 255) + d], sign = (row[1 + c] >> (8 + 2 * d) & 3) - 1;
            if (!sign || own < 0) continue;
            const REAL* const screw = screws.data + world * (SCREW * DOFS) + SCREW * own;
            REAL arm[3], column[3], by_column[3] = {0, 0, 0}, by_arm[3];
            for (int r = 0; r < 3; ++r) arm[r] = found[r] - screw[6 + r];
            joint_space::cross(screw, arm, column);
            for (int r = 0; r < 3; ++r)
                for (int e = 0; e < 3; ++e) {
                    const REAL each = sign * J_b[(at * MB + c) * 6 + 2 * r + d];
                    by_axes[3 * r + e] += each * (column[e] + screw[3 + e]);
                    by_column[e] += each * axes[3 * r + e];
                }
            joint_space::cross(by_column, screw, by_arm);
            for (int e = 0; e < 3; ++e) place[e] += by_arm[e];
        }
    // axes turn with the normal; friction does not feel how they turn about it
    for (int r = 0; r < 3; ++r) {
        REAL each[3];
        joint_space::cross(axes + 3 * r, by_axes + 3 * r, each);
        for (int e = 0; e < 3; ++e) tilt[e] += each[e];
    }
    joint_space::cross(tilt, axes, to + 3);
    for (int e = 0; e < 3; ++e) to[e] = place[e];
    if (ground) {
        to[6] = to[9] = to[10] = 0;
        to[7] = spring_b[at];
        to[8] = kd_b[at];
    } else {
        const REAL share = (REAL)1 / nears[1 + NEAR + where / MOST];
        to[6] = pair_value[PV * pair + P_STIFFNESS] * share * spring_b[at];
    }
}
EACH (contact, stiffness_bar.shape[1]) {
    REAL by[3] = {0, 0, 0};
    for (int at = 0; at < slots; ++at) {
        const int where = slot_of[at], pair = joint_space::pair_of(nears, where);
        if (table[T_PAIR + 2 * pair + 1] != contact) continue;
        const bool ground = pair >= PAIRS;
        const REAL share = ground ? 1 : (REAL)1 / nears[1 + NEAR + where / MOST];
        by[0] += ground ? h * kd_b[at] : share * FMA(slot[SLOT_FIELDS * at + DEPTH], spring_b[at], h * kd_b[at]);
        by[1] += ground ? 0 : share * kd_b[at];
        by[2] += mu_b[at];
    }
    const long long to = world * stiffness_bar.shape[1] + contact;
    stiffness_bar.data[to] = by[0];
    damping_bar.data[to] = by[1];
    friction_bar.data[to] = by[2];
}
SYNC
// -- gradients by the screws of dofs
EACH (own, DOFS) {
    REAL by[SCREW] = {0, 0, 0, 0, 0, 0, 0, 0, 0};
    const REAL* const screw = screws.data + world * (SCREW * DOFS) + SCREW * own;
    for (int at = 0; at < slots; ++at) {
        const int where = slot_of[at];
        const int* const row = table + T_COUPLE + (1 + MB) * table[T_PAIR + 2 * joint_space::pair_of(nears, where)];
        const REAL* const found = joint_space::point_of(touch, surface, where);
        for (int c = 0; c < row[0]; ++c)
            for (int d = 0; d < 2; ++d) {
                const int sign = (row[1 + c] >> (8 + 2 * d) & 3) - 1;
                if (!sign || table[T_DOF_OF + 2 * (row[1 + c] & 255) + d] != own) continue;
                REAL axes[9], arm[3], by_column[3] = {0, 0, 0}, turn[3], back[3];
                for (int r = 0; r < 3; ++r) {
                    axes[r] = found[3 + r];
                    arm[r] = found[r] - screw[6 + r];
                }
                joint_space::tangents(axes, axes + 3, axes + 6);
                for (int r = 0; r < 3; ++r)
                    for (int e = 0; e < 3; ++e)
                        by_column[e] += sign * J_b[(at * MB + c) * 6 + 2 * r + d] * axes[3 * r + e];
                joint_space::cross(arm, by_column, turn);
                joint_space::cross(screw, by_column, back);
                for (int e = 0; e < 3; ++e) {
                    by[e] += turn[e];
                    by[3 + e] += by_column[e];
                    by[6 + e] += back[e];
                }
            }
    }
    for (int e = 0; e < SCREW; ++e) screws_bar.data[world * (SCREW * DOFS) + SCREW * own + e] = by[e];
}
"""


def work_size(sizes: Sizes, passes: int) -> int:
    """Return how many scalars of memory a world takes for so many passes, a multiple of four."""
    n, tiles = 2 * sizes.tiles, sizes.tiles * (sizes.tiles + 1) // 2 + sizes.tiles
    kept = 4 * tiles + DOF_FIELDS * n + SLOT_FIELDS * sizes.slots + sizes.laws
    size = passes * kept + 5 * n + sizes.laws + (4 + 6 + 6 * sizes.columns) * sizes.slots
    return -(-size // 4) * 4


@functools.cache
def adjoint(sizes: Sizes, T: type) -> wp.Kernel:
    """Return the kernel; it launches WARP threads a world on CUDA, one on the CPU, in blocks of WARP."""
    passes = joint_passes.PASSES.replace(joint_passes.AFTER_A_PASS, AFTER)
    text = native_text(BEFORE + passes + BACK + RESULTS + joint_passes.END, sizes, T, WARP, 0)
    return native.kernel("joint_adjoint", text, ARGUMENTS, T, shared=world_bytes(sizes, T))
