"""Native code of :mod:`.joint_space`: the passes, each with laws, matrix, factors and solution, and results.

It continues the text of :mod:`.joint_points`.
"""

AFTER_A_PASS = "    // -- after a pass\n"
"""Line of PASSES where the unknown of a pass, its laws and its factors are known."""
PASSES = r"""
LOOP
for (int number = 0;; ++number) {
    const bool first = number == 0, last = number == pass_count - 1 && pass_count >= 3, done = number == pass_count;
    // -- laws of the points; after the last pass only what they say of it
    EACH (at, slots) {
        const int where = slot_of[at], pair = joint_space::pair_of(nears, where);
        const int* const row = table + T_COUPLE + (1 + MB) * table[T_PAIR + 2 * pair];
        const REAL* const value = pair_value + PV * pair;
        const REAL kd = slot[KD * S + at], mu = value[P_FRICTION], spring = slot[PUSH * S + at];
        const REAL depth = slot[DEPTH * S + at];
        const REAL before[3] = {slot[U0 * S + at], slot[(U0 + 1) * S + at], slot[(U0 + 2) * S + at]};
        REAL u[3] = {before[0], before[1], before[2]};
        if (!first) {
            LOOP
            for (int c = 0; c < row[0]; ++c) {
                const Two x = *(const Two*)(dof + X * N + 2 * (row[1 + c] & 255));
                UNROLL
                for (int r = 0; r < 3; ++r) {
                    const Two each = *(const Two*)(J + (at * MB + c) * 6 + 2 * r);
                    u[r] = FMA(each.y, x.y, FMA(each.x, x.x, u[r]));
                }
            }
        }
        const int flags = (int)slot[FLAG * S + at];
        const bool shut = flags & 1;
        const REAL push = FMA(-kd, u[0], spring), slip = sqrt(FMA(u[1], u[1], u[2] * u[2]));
        REAL across = slot[ACROSS * S + at], w = slip;
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
                slot[F * S + at] = normal;
                slot[(F + 1) * S + at] = -across * u[1];
                slot[(F + 2) * S + at] = -across * u[2];
                slot[ACROSS * S + at] = slip;
                continue;
            }
        }
        const bool closed = (candidate && (first || push > 0)) || (last && shut);
        across = mu * fn / sqrt(FMA(w, w, value[P_EPS] * value[P_EPS]));
        const REAL rigid = (REAL)RIGID / (h * value[P_WEIGHT]);
        across = across > rigid ? rigid : across;
        slot[ACROSS * S + at] = across;
        slot[FLAG * S + at] = closed + 2 * candidate;
        slot[CN * S + at] = closed ? h * kd : 0;
        slot[CT * S + at] = h * across;
        slot[F * S + at] = closed ? h * FMA(-kd, before[0], spring) : 0;
        slot[(F + 1) * S + at] = -h * across * before[1];
        slot[(F + 2) * S + at] = -h * across * before[2];
    }
    // -- laws of the dofs: drive, springs, dry friction, limits
    EACH (i, N) {
        const int own = table[T_DOF_OF + i];
        if (own < 0) {
            dof[D * N + i] = 1;
            dof[R * N + i] = 0;
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
    }
    if (done) break;
    // -- A: the mass matrix and the laws of the dofs
    EACH (t, TILES) A[t] = {{0, 0, 0, 0}};
    SYNC
    EACH (e, NNZ) {
        const int to = table[T_ENTRY + e];
        if (to >= 0) {
            A[to >> 2].x[to & 3] = held_mass[e];
        } else {
            const int i = ~to;
            A[joint_space::tile(i >> 1, i >> 1)].x[3 * (i & 1)] = held_mass[e] + dof[D * N + i];
        }
    }
    EACH (i, N) {
        if (table[T_DOF_OF + i] < 0) A[joint_space::tile(i >> 1, i >> 1)].x[3 * (i & 1)] = 1;
        A[joint_space::tile(NB, i >> 1)].x[i & 1] = dof[R * N + i];
        const int own = table[T_DOF_OF + i];  // a pivot is an inertia at least, if nothing is rounded
        dof[CHANGE * N + i] = own < 0 ? 0 : (REAL)FLOOR / dof_value[DV * own + C_WEIGHT];
    }
    SYNC
    // -- A: the points, a couple after the other; open ones are left out
    LOOP
    for (int k = 0; ANY(k < runs); ++k) {
        if (k < runs) {
            const int* const row = table + T_COUPLE + (1 + MB) * run_couple[k];
            const int begin = run_start[k], end = run_start[k + 1];
            const int blocks = row[0], triangle = blocks * (blocks + 1) / 2;
            LOOP
            for (int t = lane; t < triangle + blocks; t += LANES) {
                int a = blocks, b = t - triangle;
                if (t < triangle) joint_space::corner(t, a, b);
                REAL sum[4] = {0, 0, 0, 0};
                LOOP
                for (int at = begin; at < end; ++at) {
                    const REAL along = slot[CN * S + at], across = slot[CT * S + at];
                    if (along == 0 && across == 0) continue;
                    const Two* const one = (const Two*)(J + (at * MB + b) * 6);
                    if (t >= triangle) {
                        joint_space::push(J + (at * MB + b) * 6, slot + F * S + at, S, sum);
                        continue;
                    }
                    const Two* const other = (const Two*)(J + (at * MB + a) * 6);
                    UNROLL
                    for (int r = 0; r < 3; ++r) {
                        const REAL c = r ? across : along, x = c * one[r].x, y = c * one[r].y;
                        sum[0] = FMA(other[r].x, x, sum[0]);
                        sum[1] = FMA(other[r].x, y, sum[1]);
                        sum[2] = FMA(other[r].y, x, sum[2]);
                        sum[3] = FMA(other[r].y, y, sum[3]);
                    }
                }
                Tile& to = A[joint_space::tile(t < triangle ? row[1 + a] & 255 : NB, row[1 + b] & 255)];
                UNROLL
                for (int e = 0; e < 4; ++e) to.x[e] += sum[e];
            }
        }
        SYNC
    }
    // -- Cholesky, a column of tiles after the other; the right side is the last row
    floored = false;
    LOOP
    for (int j = 0; j < NB; ++j) {
        const int below = count[j];
        const unsigned char* const list = rows + j * (NB + 1);
        const Tile diagonal = A[joint_space::tile(j, j)];
        const REAL d0 = diagonal.x[0], least0 = dof[CHANGE * N + 2 * j], least1 = dof[CHANGE * N + 2 * j + 1];
        const REAL i0 = joint_space::inverse_root(d0 < least0 ? least0 : d0), l10 = diagonal.x[2] * i0;
        const REAL d1 = FMA(-l10, l10, diagonal.x[3]), i1 = joint_space::inverse_root(d1 < least1 ? least1 : d1);
        floored |= d0 < least0 || d1 < least1;
        if (lane == 0) {
            dof[I0 * N + j] = i0;
            dof[L10 * N + j] = l10;
            dof[I1 * N + j] = i1;
        }
        EACH (a, below) {
            Tile& to = A[joint_space::tile(list[a], j)];
            const Tile x = to;
            Tile y;
            UNROLL
            for (int r = 0; r < 4; r += 2) {
                y.x[r] = x.x[r] * i0;
                y.x[r + 1] = FMA(-l10, y.x[r], x.x[r + 1]) * i1;
            }
            to = y;
        }
        SYNC
        LOOP
        for (int t = lane; t < below * (below + 1) / 2 - 1; t += LANES) {
            int a, b;
            joint_space::corner(t, a, b);
            const Tile x = A[joint_space::tile(list[a], j)], y = A[joint_space::tile(list[b], j)];
            Tile& to = A[joint_space::tile(list[a], list[b])];
            Tile z = to;
            UNROLL
            for (int e = 0; e < 4; ++e) {
                const int r = e & 2, c = 2 * (e & 1);
                z.x[e] = FMA(-x.x[r + 1], y.x[c + 1], FMA(-x.x[r], y.x[c], z.x[e]));
            }
            to = z;
        }
        SYNC
    }
    // -- back substitution, and in the last pass a step of refinement with the same factor
    LOOP
    for (int refined = 0;; ++refined) {
        LOOP
        for (int j = NB - 1; j >= 0; --j) {
            const Tile& y = A[joint_space::tile(NB, j)];
            const REAL x1 = y.x[1] * dof[I1 * N + j], x0 = FMA(-dof[L10 * N + j], x1, y.x[0]) * dof[I0 * N + j];
            if (lane == 0) {
                dof[CHANGE * N + 2 * j] = x0;
                dof[CHANGE * N + 2 * j + 1] = x1;
            }
            EACH (k, j) {
                const Tile x = A[joint_space::tile(j, k)];
                Tile& to = A[joint_space::tile(NB, k)];
                to.x[0] = FMA(-x.x[2], x1, FMA(-x.x[0], x0, to.x[0]));
                to.x[1] = FMA(-x.x[3], x1, FMA(-x.x[1], x0, to.x[1]));
            }
            SYNC
        }
        const bool more = number == pass_count - 1 && refined < REFINE;
        EACH (i, N) {
            const REAL x = dof[CHANGE * N + i];
            dof[X * N + i] = refined ? dof[X * N + i] + x : x;
            if (!more) continue;
            REAL left = FMA(-dof[D * N + i], x, dof[R * N + i]);
            for (int e = table[T_ROW_START + i]; e < table[T_ROW_START + i + 1]; ++e)
                left = FMA(-held_mass[table[T_ROW + e] >> 8], dof[CHANGE * N + (table[T_ROW + e] & 255)], left);
            dof[R * N + i] = left;
            A[joint_space::tile(NB, i >> 1)].x[i & 1] = left;
        }
        if (!more) break;
        EACH (at, slots) {
            const int* const row = table + T_COUPLE
                + (1 + MB) * table[T_PAIR + 2 * joint_space::pair_of(nears, slot_of[at])];
            REAL u[3] = {0, 0, 0};
            LOOP
            for (int c = 0; c < row[0]; ++c) {
                const Two x = *(const Two*)(dof + CHANGE * N + 2 * (row[1 + c] & 255));
                UNROLL
                for (int r = 0; r < 3; ++r) {
                    const Two each = *(const Two*)(J + (at * MB + c) * 6 + 2 * r);
                    u[r] = FMA(each.y, x.y, FMA(each.x, x.x, u[r]));
                }
            }
            UNROLL
            for (int r = 0; r < 3; ++r)
                slot[(F + r) * S + at] = FMA(-slot[(r ? CT : CN) * S + at], u[r], slot[(F + r) * S + at]);
        }
        SYNC
        LOOP
        for (int k = 0; ANY(k < runs); ++k) {
            if (k < runs) {
                const int* const row = table + T_COUPLE + (1 + MB) * run_couple[k];
                LOOP
                EACH (b, row[0]) {
                    REAL sum[2] = {0, 0};
                    LOOP
                    for (int at = run_start[k]; at < run_start[k + 1]; ++at)
                        joint_space::push(J + (at * MB + b) * 6, slot + F * S + at, S, sum);
                    Tile& to = A[joint_space::tile(NB, row[1 + b] & 255)];
                    to.x[0] += sum[0];
                    to.x[1] += sum[1];
                }
            }
            SYNC
        }
        LOOP
        for (int j = 0; j < NB; ++j) {
            const int below = count[j] - 1;
            const unsigned char* const list = rows + j * (NB + 1);
            Tile& own = A[joint_space::tile(NB, j)];
            const REAL y0 = own.x[0] * dof[I0 * N + j];
            const REAL y1 = FMA(-dof[L10 * N + j], y0, own.x[1]) * dof[I1 * N + j];
            EACH (a, below) {
                const Tile x = A[joint_space::tile(list[a], j)];
                Tile& to = A[joint_space::tile(NB, list[a])];
                to.x[0] = FMA(-x.x[1], y1, FMA(-x.x[0], y0, to.x[0]));
                to.x[1] = FMA(-x.x[3], y1, FMA(-x.x[2], y0, to.x[1]));
            }
            SYNC
            if (lane == 0) {
                own.x[0] = y0;
                own.x[1] = y1;
            }
        }
        SYNC
    }
    SYNC
    // -- after a pass
}
"""
RESULTS = r"""// -- results
SYNC
REAL *const excesses = s + AT_A;
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
LOOP
EACH (i, PV * (PAIRS + SURFACES) + 1) wrong |= joint_space::lost(pair_value[i]) ? 2 : 0;
LOOP
EACH (i, LAW * LAWS) wrong |= joint_space::lost(motor[i]) ? 2 : 0;
LOOP
EACH (i, DV * DOFS) wrong |= joint_space::lost(dof_value[i]) ? 2 : 0;
LOOP
EACH (i, SURFACES) missed = surface[i * SURFACE + 10] > 0 ? (REAL)1e30 : missed;  // comes out of the ground slowly
excesses[5 * lane] = cone;
excesses[5 * lane + 1] = pull;
excesses[5 * lane + 2] = effort_excess;
excesses[5 * lane + 3] = missed;
excesses[5 * lane + 4] = (REAL)wrong;
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
        for (int at = 0; at < slots; ++at) {
            const int where = slot_of[at];
            if (where < NEAR * MOST || table[T_PAIR + 2 * joint_space::pair_of(nears, where) + 1] != point) continue;
            const REAL* const found = joint_space::point_of(touch, surface, where);
            joint_space::add_force(found + 3, slot + F * S + at, S, f);
            if (!any) slip = slot[ACROSS * S + at];
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
        for (int at = 0; at < slots; ++at) {
            const int where = slot_of[at];
            if (where >= NEAR * MOST || where / MOST != k) continue;
            if (slot[DEPTH * S + at] > deepest) {
                deepest = slot[DEPTH * S + at];
                slip = slot[ACROSS * S + at];
            }
            joint_space::add_force(touch + where * POINT + 3, slot + F * S + at, S, f);
        }
        const long long row = world * contact_f.shape[1] + table[T_PAIR + 2 * nears[1 + k] + 1];
        for (int c = 0; c < 3; ++c) contact_f.data[row * 3 + c] = f[c];
        contact_gap.data[row] = -deepest;
        contact_slip.data[row] = slip;
    }
    if (lane == 0) {
        REAL worst[4] = {0, 0, 0, 0};
        int all_wrong = 0;
        LOOP
        for (int l = 0; l < LANES; ++l) {
            for (int e = 0; e < 4; ++e) worst[e] = excesses[5 * l + e] > worst[e] ? excesses[5 * l + e] : worst[e];
            all_wrong |= (int)excesses[5 * l + 4];
        }
        for (int e = 0; e < 3; ++e) excess.data[world * 3 + e] = worst[e];
        const bool beyond = worst[0] > most_force || worst[1] > most_force || worst[3] > most_force
            || worst[2] > most_effort;
        const bool crowded = total > S - SURFACES || nears[0] > NEAR;
        status.data[world] = all_wrong & 2 ? NOT_FINITE : all_wrong ? PIVOT : crowded ? CROWDED : beyond ? CONTACT : 0;
    }
}
"""
END = r"""#undef LANES
#undef SYNC
#undef ANY
#undef EACH
"""
