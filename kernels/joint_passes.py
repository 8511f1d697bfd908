"""Native code of :mod:`.joint_space`: the passes, each with laws, matrix, factors and solution, and results.

It continues the text of :mod:`.joint_points`.
"""

AFTER_A_PASS = "    // -- after a pass\n"
"""Line of PASSES where the unknown of a pass, its laws and its factors are known."""
PASSES = r"""
int lane_a, lane_b, next_a, next_b;  // of the first two rounds of products of a column
joint_space::corner(lane, lane_a, lane_b);
joint_space::corner(lane + LANES, next_a, next_b);
LOOP
for (int number = 0;; ++number) {
    const bool first = number == 0, last = number == pass_count - 1 && pass_count >= 3, done = number == pass_count;
    EACH (w, SLOT_WORDS) active[w] = 0;
    SYNC
    // -- laws of the points; after the last pass only what they say of it
    EACH (at, slots) {
        const int pair = slot_pair[at];
        const REAL* const value = pair_value + PV * pair;
        const REAL kd = slot[SLOT_FIELDS * at + KD], mu = value[P_FRICTION], spring = slot[SLOT_FIELDS * at + PUSH];
        const REAL depth = slot[SLOT_FIELDS * at + DEPTH];
        const REAL* const was = slot + SLOT_FIELDS * at + U0;
        const REAL before[3] = {was[0], was[1], was[2]};
        REAL u[3] = {before[0], before[1], before[2]};
        if (!first) joint_space::add_velocity(J + at * MB * 6, slot_mask + at * WORDS, dof + X * N, u);
        const int flags = (int)slot[SLOT_FIELDS * at + FLAG];
        const bool shut = flags & 1;
        const REAL push = FMA(-kd, u[0], spring), slip = sqrt(FMA(u[1], u[1], u[2] * u[2]));
        REAL across = slot[SLOT_FIELDS * at + ACROSS], w = slip;
        bool candidate;
        REAL fn;
        if (first) {
            candidate = (u[0] < 0 ? FMA(-h, u[0], depth) : depth) + half_gravity * h * h > 0;
            fn = candidate ? joint_space::positive(push) : 0;
        } else {
            const REAL normal = shut ? push : 0;
            fn = joint_space::positive(normal);
            const REAL over = joint_space::positive(FMA(across, slip, -(mu * fn)));
            w = FMA(h * value[P_WEIGHT], over, slip);
            candidate = (flags & 2) || FMA(-h, u[0], depth) > 0;
            if (done) {
                cone = over > cone ? over : cone;
                pull = -normal > pull ? -normal : pull;
                const REAL lacks = shut || !candidate ? 0 : joint_space::positive(push);
                missed = lacks > missed ? lacks : missed;
                slot[SLOT_FIELDS * at + F] = normal;
                slot[SLOT_FIELDS * at + F + 1] = -across * u[1];
                slot[SLOT_FIELDS * at + F + 2] = -across * u[2];
                slot[SLOT_FIELDS * at + ACROSS] = slip;
                continue;
            }
        }
        const bool closed = (candidate && (first || push > 0)) || (last && shut);
        across = mu * fn * joint_space::inverse_root(FMA(w, w, value[P_EPS] * value[P_EPS]));
        const REAL rigid = (REAL)RIGID * joint_space::inverse(h * value[P_WEIGHT]);
        across = across > rigid ? rigid : across;
        slot[SLOT_FIELDS * at + ACROSS] = across;
        slot[SLOT_FIELDS * at + FLAG] = closed + 2 * candidate;
        if (closed || across > 0) joint_space::set_bits(active + at / 32, 1u << (at & 31));
        slot[SLOT_FIELDS * at + CN] = closed ? h * kd : 0;
        slot[SLOT_FIELDS * at + CT] = h * across;
        slot[SLOT_FIELDS * at + F] = closed ? h * FMA(-kd, before[0], spring) : 0;
        slot[SLOT_FIELDS * at + F + 1] = -h * across * before[1];
        slot[SLOT_FIELDS * at + F + 2] = -h * across * before[2];
    }
    // -- laws of the dofs: drive, springs, dry friction, limits
    EACH (i, N) {
        const int own = table[T_DOF_OF + i];
        if (own < 0) {
            dof[D * N + i] = 1;
            dof[R * N + i] = dof[CHANGE * N + i] = 0;
            continue;
        }
        const REAL* const value = dof_value + DV * own;
        const int coordinate = table[T_COORDINATE + own];
        const REAL before = dof[V0 * N + i], v = first ? before : before + dof[X * N + i];
        const REAL at = coordinate < 0 ? 0 : q.data[world * q.shape[1] + coordinate], effort = value[C_EFFORT];
        const REAL most = effort > 0 ? FMA(h, value[C_KE], value[C_KD]) : 0;
        REAL aim = 0, drive = 0;
        if (most > 0) {
            aim = value[C_KD] * target_qd.data[world * DOFS + own];
            if (coordinate >= 0) aim += value[C_KE] * (target_q.data[world * q.shape[1] + coordinate] - at);
            aim /= most;
            const REAL beyond = first ? 0 : joint_space::positive(
                joint_space::size_of(dof[DRIVE * N + i] * (aim - v)) - effort);
            effort_excess = done && beyond > effort_excess ? beyond : effort_excess;
            const REAL w = FMA(h * value[C_WEIGHT], beyond, joint_space::size_of(v - aim));
            drive = most * w > effort ? effort / w : most;
            dof[DRIVE * N + i] = drive;
        }
        REAL resistance = FMA(h, value[C_STIFFNESS], value[C_DAMPING]) + drive;
        REAL force = FMA(drive, aim, dof[LOAD * N + i]);
        LOOP
        for (int l = LAWS ? table[T_LAW + own] : 0; l < (LAWS ? table[T_LAW + own + 1] : 0); ++l) {
            const REAL* const law = motor + LAW * l;
            const REAL line = FMA(-law[1], v - before, law[0]), least = law[2], most = law[3], scale = law[4];
            const bool low = least > (REAL)-1e29, high = most < (REAL)1e29;
            REAL part = scale, fixed = 0;
            if (low && high) {
                REAL beyond = 0;
                if (!first) {
                    const REAL bound = joint_space::positive(line > 0 ? most : -least);
                    beyond = joint_space::positive(FMA(shares[l], joint_space::size_of(line), -bound));
                    effort_excess = done && scale * beyond > effort_excess ? scale * beyond : effort_excess;
                }
                const REAL share = joint_space::share(law, line, scale * law[1] * (h * value[C_WEIGHT] * beyond));
                shares[l] = share;
                part = scale * share;
                if (least > 0 || most < 0) {  // where the line pushes the other way, the bound acts as a force
                    const bool outside = (line > 0 ? most : -least) < 0;
                    fixed = outside ? scale * (line < least ? least : line > most ? most : line) : 0;
                    part = outside ? 0 : part;
                }
            } else if ((low && line < least) || (high && line > most)) {
                fixed = scale * (low ? least : most);
                part = 0;
            }
            resistance = FMA(part, law[1], resistance);
            force += FMA(part, FMA(law[1], before, law[0]), fixed);
        }
        if (done) continue;
        if (coordinate >= 0) force += value[C_STIFFNESS] * (value[C_REST] - at);
        if (value[C_DRY] > 0) {
            REAL w = joint_space::size_of(v);
            if (!first) w = FMA(h * value[C_WEIGHT], joint_space::positive(FMA(dof[DRY * N + i], w, -value[C_DRY])), w);
            const REAL dry = value[C_DRY] / sqrt(FMA(w, w, (REAL)1e-8));
            dof[DRY * N + i] = dry;
            resistance += dry;
        }
        if (coordinate >= 0) {
            const int were = first ? 0 : (int)dof[LIMIT * N + i];
            int on = 0;
            UNROLL
            for (int side = 0; side < 2; ++side) {
                const REAL way = side ? -1 : 1, depth = way * (value[C_LOWER + side] - at), inward = way * v;
                const REAL k = value[C_LIMIT_KE], d = FMA(h, k, depth > 0 ? value[C_LIMIT_KD] : 0);
                const bool bounded = joint_space::size_of(value[C_LOWER + side]) < (REAL)1e10;
                const bool held = bounded
                    && (first ? FMA(h, joint_space::positive(-inward), depth) > 0 : FMA(k, depth, -(d * inward)) > 0);
                const bool by_rule = last && !held && (were >> side & 1);
                if (held || by_rule) {
                    on |= 1 << side;
                    resistance += d;
                    force += way * k * (by_rule ? joint_space::positive(depth) : depth);
                }
            }
            dof[LIMIT * N + i] = on;
        }
        if (joint_space::size_of(v) > value[C_FASTEST]) {
            resistance += value[C_BRAKE] / h;
            force += value[C_BRAKE] / h * (v < 0 ? -value[C_FASTEST] : value[C_FASTEST]);
        }
        dof[D * N + i] = h * resistance;
        dof[R * N + i] = h * FMA(-resistance, before, force);
        dof[CHANGE * N + i] = (REAL)FLOOR / value[C_WEIGHT];  // a pivot is an inertia at least, if nothing is rounded
    }
    if (done) break;
    SYNC
    // -- A: of each tile the mass matrix, the laws of the dofs, and the points that are not open
    LOOP
    for (int item = lane; item < start[NB]; item += LANES) {
        const int i = list[item] >> 8, j = list[item] & 255;
        const unsigned int *const to_i = touching + i * SLOT_WORDS, *const to_j = touching + j * SLOT_WORDS;
        Tile sum = {{0, 0, 0, 0}};
        if (i == NB) {
            sum.x[0] = dof[R * N + 2 * j];
            sum.x[1] = dof[R * N + 2 * j + 1];
        } else {
            const int held = table[T_HELD + joint_space::tile(i, j)];
            if (held >= 0) sum = *(const Tile*)(held_mass + 4 * held);
            if (i == j) {
                sum.x[0] += dof[D * N + 2 * j];
                sum.x[3] += dof[D * N + 2 * j + 1];
            }
        }
        int pair = -1, from_j = 0, from_i = 0;
        LOOP
        for (int w = 0; w < SLOT_WORDS; ++w) {
            LOOP
            for (unsigned int left = to_j[w] & active[w] & (i == NB ? ~0u : to_i[w]); left; left &= left - 1) {
                const int at = 32 * w + joint_space::first_of(left);
                if (slot_pair[at] != pair) {
                    pair = slot_pair[at];
                    from_j = 6 * joint_space::rank(slot_mask + at * WORDS, j);
                    from_i = i == NB ? 0 : 6 * joint_space::rank(slot_mask + at * WORDS, i);
                }
                const REAL *const one = J + at * (6 * MB) + from_j, *const other = J + at * (6 * MB) + from_i;
                if (i == NB) {
                    joint_space::push(one, slot + SLOT_FIELDS * at + F, sum.x);
                    continue;
                }
                UNROLL
                for (int r = 0; r < 3; ++r) {
                    const REAL c = slot[SLOT_FIELDS * at + (r ? CT : CN)];
                    const Two a = *(const Two*)(one + 2 * r), b = *(const Two*)(other + 2 * r);
                    const REAL x = c * a.x, y = c * a.y;
                    sum.x[0] = FMA(b.x, x, sum.x[0]);
                    sum.x[1] = FMA(b.x, y, sum.x[1]);
                    sum.x[2] = FMA(b.y, x, sum.x[2]);
                    sum.x[3] = FMA(b.y, y, sum.x[3]);
                }
            }
        }
        A[joint_space::tile(i, j)] = sum;
    }
    SYNC
    // -- factors, a column of tiles after the other; the right side is the last row
    LOOP
    for (int j = 0, from = 0, next; j < NB; ++j, from = next) {
        next = start[j + 1];
        const unsigned short* const rows = list + from + 1;
        const int below = next - from - 1, products = below * (below + 1) / 2 - 1;
        const Pivot p = joint_space::pivot(A[joint_space::tile(j, j)], dof + CHANGE * N + 2 * j);
        int a = lane_a, b = lane_b;
        LOOP
        for (int t = lane; t < products; t += LANES) {
            if (t >= 2 * LANES) joint_space::corner(t, a, b);
            const int i = rows[a] >> 8, k = rows[b] >> 8;
            const Tile x = A[joint_space::tile(i, j)];
            Tile y = A[joint_space::tile(k, j)];
            Tile& to = A[joint_space::tile(i, k)];
            Tile z = to;
            UNROLL
            for (int c = 0; c < 2; ++c) {
                joint_space::divide(p.i0, p.l, p.i1, y.x[2 * c], y.x[2 * c + 1]);
                z.x[c] = FMA(-x.x[1], y.x[2 * c + 1], FMA(-x.x[0], y.x[2 * c], z.x[c]));
                z.x[2 + c] = FMA(-x.x[3], y.x[2 * c + 1], FMA(-x.x[2], y.x[2 * c], z.x[2 + c]));
            }
            to = z;
            a = next_a;
            b = next_b;
        }
        SYNC
    }
    floored = false;
    EACH (j, NB) {
        const Pivot p = joint_space::pivot(A[joint_space::tile(j, j)], dof + CHANGE * N + 2 * j);
        floored |= p.low;
        dof[I0 * N + j] = p.i0;
        dof[L10 * N + j] = p.l;
        dof[I1 * N + j] = p.i1;
    }
    SYNC
    // -- back substitution, and in the last pass a step of refinement with the same factors
    LOOP
    for (int refined = 0;; ++refined) {
        // a lane has the right side of its blocks; what is not listed of a row is zero
        REAL own[EACH_LANE][2];
        UNROLL_LANES
        for (int p = 0; p < EACH_LANE; ++p) {
            const int k = lane + p * LANES;
            const Tile& y = A[joint_space::tile(NB, k < NB ? k : 0)];
            own[p][0] = y.x[0];
            own[p][1] = y.x[1];
        }
        LOOP
        for (int j = NB - 1; j >= 0; --j) {
            REAL x0, x1;
            joint_space::share_two(own, j, x0, x1);
            joint_space::divide(dof[I0 * N + j], dof[L10 * N + j], dof[I1 * N + j], x0, x1);
            UNROLL_LANES
            for (int p = 0; p < EACH_LANE; ++p) {
                const int k = lane + p * LANES;
                if (k == j) {
                    own[p][0] = x0;
                    own[p][1] = x1;
                }
                if (k >= j) continue;
                const Tile x = A[joint_space::tile(j, k)];
                own[p][0] = FMA(-x.x[2], x1, FMA(-x.x[0], x0, own[p][0]));
                own[p][1] = FMA(-x.x[3], x1, FMA(-x.x[1], x0, own[p][1]));
            }
        }
        UNROLL_LANES
        for (int p = 0; p < EACH_LANE; ++p) {
            const int k = lane + p * LANES;
            if (k >= NB) continue;
            dof[CHANGE * N + 2 * k] = own[p][0];
            dof[CHANGE * N + 2 * k + 1] = own[p][1];
        }
        SYNC
        const bool more = number == pass_count - 1 && refined < REFINE;
        EACH (i, N) {
            const REAL x = dof[CHANGE * N + i];
            dof[X * N + i] = refined ? dof[X * N + i] + x : x;
            if (!more) continue;
            REAL left = FMA(-dof[D * N + i], x, dof[R * N + i]);
            for (int e = table[T_ROW_START + i]; e < table[T_ROW_START + i + 1]; ++e)
                left = FMA(-held_mass[table[T_ROW + e] >> 8], dof[CHANGE * N + (table[T_ROW + e] & 255)], left);
            dof[R * N + i] = left;
        }
        if (!more) break;
        EACH (at, slots) {
            REAL u[3] = {0, 0, 0}, *const load = slot + SLOT_FIELDS * at;
            joint_space::add_velocity(J + at * MB * 6, slot_mask + at * WORDS, dof + CHANGE * N, u);
            UNROLL
            for (int r = 0; r < 3; ++r)
                load[F + r] = FMA(-load[r ? CT : CN], u[r], load[F + r]);
        }
        SYNC
        EACH (j, NB) {
            REAL sum[2] = {dof[R * N + 2 * j], dof[R * N + 2 * j + 1]};
            LOOP
            for (int w = 0; w < SLOT_WORDS; ++w) {
                LOOP
                for (unsigned int left = touching[j * SLOT_WORDS + w] & active[w]; left; left &= left - 1) {
                    const int at = 32 * w + joint_space::first_of(left);
                    const int c = joint_space::rank(slot_mask + at * WORDS, j);
                    joint_space::push(J + (at * MB + c) * 6, slot + SLOT_FIELDS * at + F, sum);
                }
            }
            A[joint_space::tile(NB, j)] = {{sum[0], sum[1], 0, 0}};
        }
        SYNC
        UNROLL_LANES
        for (int p = 0; p < EACH_LANE; ++p) {
            const int k = lane + p * LANES;
            const Tile& y = A[joint_space::tile(NB, k < NB ? k : 0)];
            own[p][0] = y.x[0];
            own[p][1] = y.x[1];
        }
        LOOP
        for (int j = 0; j < NB - 1; ++j) {
            REAL y0, y1;
            joint_space::share_two(own, j, y0, y1);
            joint_space::divide(dof[I0 * N + j], dof[L10 * N + j], dof[I1 * N + j], y0, y1);
            UNROLL_LANES
            for (int p = 0; p < EACH_LANE; ++p) {
                const int k = lane + p * LANES;
                if (k <= j || k >= NB) continue;
                const Tile x = A[joint_space::tile(k, j)];
                own[p][0] = FMA(-x.x[1], y1, FMA(-x.x[0], y0, own[p][0]));
                own[p][1] = FMA(-x.x[3], y1, FMA(-x.x[2], y0, own[p][1]));
            }
        }
        UNROLL_LANES
        for (int p = 0; p < EACH_LANE; ++p) {
            const int k = lane + p * LANES;
            if (k < NB) A[joint_space::tile(NB, k)] = {{own[p][0], own[p][1], 0, 0}};
        }
        SYNC
    }
    SYNC
    // -- after a pass
}
"""
RESULTS = r"""// -- results
SYNC
int wrong = floored;  // 1: a result is no number, or rounding is more than a pivot; 2: an input is none
LOOP
EACH (i, N) {
    const int own = table[T_DOF_OF + i];
    if (own < 0) continue;
    const long long at = world * DOFS + own;
    wrong |= joint_space::lost(dof[X * N + i]);
    const REAL given = tau.data[at] + qd.data[at] + target_qd.data[at] + bias.data[at];
    wrong |= joint_space::lost(given) ? 2 : 0;
    if (table[T_COORDINATE + own] >= 0)
        wrong |= joint_space::lost(target_q.data[world * q.shape[1] + table[T_COORDINATE + own]]) ? 2 : 0;
}
if (pair_values.shape[0] > 1) EACH (i, PV * (PAIRS + SURFACES) + 1) wrong |= joint_space::lost(pair_value[i]) ? 2 : 0;
LOOP
EACH (i, LAW * LAWS) wrong |= joint_space::lost(motor[i]) ? 2 : 0;
if (dof_values.shape[0] > 1) EACH (i, DV * DOFS) wrong |= joint_space::lost(dof_value[i]) ? 2 : 0;
LOOP
EACH (i, SURFACES) missed = surface[i * SURFACE + 10] > 0 ? (REAL)1e30 : missed;  // comes out of the ground slowly
cone = joint_space::largest(cone);
pull = joint_space::largest(pull);
effort_excess = joint_space::largest(effort_excess);
missed = joint_space::largest(missed);
wrong = joint_space::any_bits(wrong);
if (alive) {
    EACH (i, N) {
        const int own = table[T_DOF_OF + i];
        if (own < 0) continue;
        qdd.data[world * DOFS + own] = dof[X * N + i] / h;
        out.data[world * DOFS + own] = dof[V0 * N + i] + dof[X * N + i];
    }
    EACH (k, PAIRS) {
        const long long row = world * contact_f.shape[1] + table[T_PAIR + 2 * k + 1];
        for (int c = 0; c < 3; ++c) contact_f.data[row * 3 + c] = 0;
        contact_gap.data[row] = AWAY;
        contact_slip.data[row] = 0;
    }
    EACH (point, CONTACT_POINTS) {  // all surfaces of a point with the ground have slots
        REAL f[3] = {0, 0, 0}, gap = 0, slip = 0;
        bool any = false;
        LOOP
        for (int at = paired; at < slots; ++at) {
            const int where = slot_of[at];
            if (table[T_PAIR + 2 * slot_pair[at] + 1] != point) continue;
            const REAL* const found = joint_space::point_of(touch, surface, where);
            joint_space::add_force(found + 3, slot + SLOT_FIELDS * at + F, f);
            if (!any) slip = slot[SLOT_FIELDS * at + ACROSS];
            gap = !any || found[9] < gap ? found[9] : gap;
            any = true;
        }
        const long long row = world * contact_f.shape[1] + point;
        for (int c = 0; c < 3; ++c) contact_f.data[row * 3 + c] = f[c];
        contact_gap.data[row] = gap;
        contact_slip.data[row] = slip;
    }
}
SYNC
if (alive) {
    EACH (k, number_near) {
        if (nears[1 + k] < 0) continue;
        REAL f[3] = {0, 0, 0}, deepest = -AWAY, slip = 0;
        for (int at = begin[k]; at < begin[k + 1]; ++at) {
            if (slot[SLOT_FIELDS * at + DEPTH] > deepest) {
                deepest = slot[SLOT_FIELDS * at + DEPTH];
                slip = slot[SLOT_FIELDS * at + ACROSS];
            }
            joint_space::add_force(touch + slot_of[at] * POINT + 3, slot + SLOT_FIELDS * at + F, f);
        }
        const long long row = world * contact_f.shape[1] + table[T_PAIR + 2 * nears[1 + k] + 1];
        for (int c = 0; c < 3; ++c) contact_f.data[row * 3 + c] = f[c];
        contact_gap.data[row] = -deepest;
        contact_slip.data[row] = slip;
    }
    if (lane == 0) {
        excess.data[world * 3] = cone;
        excess.data[world * 3 + 1] = pull;
        excess.data[world * 3 + 2] = effort_excess;
        const REAL apart = cone > pull ? cone : pull;  // from the laws of the points
        const bool beyond = apart > most_force || missed > most_force || effort_excess > most_effort;
        const bool crowded = total > S - SURFACES || nears[0] > NEAR;
        status.data[world] = wrong & 2 ? NOT_FINITE : wrong ? PIVOT : crowded ? CROWDED : beyond ? CONTACT : 0;
    }
}
"""
END = r"""#undef LANES
#undef SYNC
#undef ANY
#undef EACH
#undef EACH_LANE
"""
