"""Convex shapes for :mod:`.convex_pairs`: where they are farthest along a direction, and the face that looks there.

A shape is a core grown by a radius: a sphere's core is its centre, a capsule's the segment along its z axis, and all
others are their own core. Sizes are half those along the axes; those of a cylinder are its radius, its radius and half
its length along z. A hull is its corners about a place inside of it, and its faces: planes n . x = d and, of each, the
corners that go round it counterclockwise, seen from outside.
"""

SPHERE, CAPSULE, BOX, CYLINDER, ELLIPSOID, HULL, PLANE = range(7)
KINDS = ("sphere", "capsule", "box", "cylinder", "ellipsoid", "hull", "plane")
"""Names of the kinds, in the order of their numbers; a plane is the half space below z = 0 of its pose."""
ROW = 5  # integers of a shape: its kind, where its corners and faces begin, and how many there are
SIZES = 4  # numbers of a shape: its sizes and its radius
LARGEST_FACE = 12  # corners that count of a face with more of them; they lie as evenly as can be

NATIVE = r"""
    enum { SPHERE, CAPSULE, BOX, CYLINDER, ELLIPSOID, HULL, PLANE };

    static CUDA_CALLABLE inline REAL dot(const REAL* a, const REAL* b)
    {
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    }

    static CUDA_CALLABLE inline void cross(const REAL* a, const REAL* b, REAL* to)
    {
        to[0] = a[1] * b[2] - a[2] * b[1];
        to[1] = a[2] * b[0] - a[0] * b[2];
        to[2] = a[0] * b[1] - a[1] * b[0];
    }

    static CUDA_CALLABLE inline REAL size_of(REAL x) { return x < 0 ? -x : x; }

    static CUDA_CALLABLE inline REAL within(REAL x, REAL low, REAL high) { return x < low ? low : x > high ? high : x; }

    // R v, and R' v.
    static CUDA_CALLABLE inline void turned(const REAL* turn, const REAL* v, REAL* to)
    {
        UNROLL
        for (int r = 0; r < 3; ++r) to[r] = dot(turn + 3 * r, v);
    }

    static CUDA_CALLABLE inline void turned_back(const REAL* turn, const REAL* v, REAL* to)
    {
        UNROLL
        for (int r = 0; r < 3; ++r) to[r] = turn[r] * v[0] + turn[3 + r] * v[1] + turn[6 + r] * v[2];
    }

    // What hulls are made of, for all shapes: corners and planes, where the corners of each face begin, and these.
    struct Tables
    {
        const REAL *corner, *plane;
        const int *first, *loop;
    };

    struct Shape
    {
        int kind, corner, corners, face, faces;
        REAL size[3], radius;

        CUDA_CALLABLE inline REAL least() const
        {
            if (kind == SPHERE || kind == CAPSULE) return radius;
            const REAL x = size[0] < size[1] ? size[0] : size[1];
            return x < size[2] ? x : size[2];
        }
    };

    // Whether other shapes touch it in one point alone.
    static CUDA_CALLABLE inline bool is_point(const Shape& shape)
    {
        return shape.kind == SPHERE || shape.kind == ELLIPSOID;
    }

    // The point of a shape's core that is farthest along ``d``, of any length, in the shape's axes.
    static CUDA_CALLABLE inline void support(const Shape& shape, const Tables& tables, const REAL* d, REAL* x)
    {
        if (shape.kind == HULL) {
            const REAL* corner = tables.corner + 3 * shape.corner;
            REAL most = dot(corner, d);
            int best = 0;
            LOOP
            for (int i = 1; i < shape.corners; ++i) {
                const REAL height = dot(corner + 3 * i, d);
                best = height > most ? i : best;
                most = height > most ? height : most;
            }
            UNROLL
            for (int r = 0; r < 3; ++r) x[r] = corner[3 * best + r];
            return;
        }
        REAL scale[3];
        UNROLL
        for (int r = 0; r < 3; ++r) scale[r] = d[r] < 0 ? -shape.size[r] : shape.size[r];
        if (shape.kind == CYLINDER) {
            const REAL across = d[0] * d[0] + d[1] * d[1];
            const REAL share = across > (REAL)1e-12 * d[2] * d[2] ? shape.size[0] / sqrt(across) : 0;
            scale[0] = share * d[0];
            scale[1] = share * d[1];
        }
        if (shape.kind == ELLIPSOID) {
            REAL y[3];
            UNROLL
            for (int r = 0; r < 3; ++r) y[r] = shape.size[r] * d[r];
            const REAL length = sqrt(dot(y, y));
            UNROLL
            for (int r = 0; r < 3; ++r) scale[r] = shape.size[r] * y[r] / length;
        }
        UNROLL
        for (int r = 0; r < 3; ++r) x[r] = scale[r];
    }

    // How many normals a shape has that are worth a look, and the outward one of them, with how far it reaches along
    // it; ``other`` is a place in the other shape. All in the shape's axes.
    static CUDA_CALLABLE inline int normals_of(const Shape& shape)
    {
        const int kind = shape.kind;
        return kind == HULL ? shape.faces : kind == BOX || kind == CYLINDER ? 3 : kind == ELLIPSOID ? 1 : 0;
    }

    static CUDA_CALLABLE inline REAL normal_of(const Shape& shape, const Tables& tables, int i, const REAL* other,
        REAL* u)
    {
        if (shape.kind == HULL) {
            const REAL* plane = tables.plane + 4 * (shape.face + i);
            UNROLL
            for (int r = 0; r < 3; ++r) u[r] = plane[r];
            return plane[3];
        }
        UNROLL
        for (int r = 0; r < 3; ++r) u[r] = r != i ? 0 : other[r] < 0 ? -1 : 1;
        if (shape.kind == CYLINDER && i == 0) {
            const REAL across = sqrt(other[0] * other[0] + other[1] * other[1]);
            u[0] = across > 0 ? other[0] / across : 1;
            u[1] = across > 0 ? other[1] / across : 0;
        }
        if (shape.kind == ELLIPSOID) {
            UNROLL
            for (int r = 0; r < 3; ++r) u[r] = other[r] / (shape.size[r] * shape.size[r]);
            const REAL length = sqrt(dot(u, u));
            REAL y[3];
            UNROLL
            for (int r = 0; r < 3; ++r) {
                u[r] = length > 0 ? u[r] / length : r == 0;
                y[r] = shape.size[r] * u[r];
            }
            return sqrt(dot(y, y));
        }
        return i == 0 ? shape.size[0] : i == 1 ? shape.size[1] : shape.size[2];
    }

    // What of a shape looks along a direction: a polygon, a segment or a point, in any axes. The corners of a hull's
    // face are looked up and turned; the others are middle + x u + y v.
    struct Feature
    {
        int count, begin, stride, corners;  // corners: of the hull's face; 0: no hull
        const REAL* corner;
        const int* loop;
        REAL middle[3], u[3], v[3], normal[3], turn[9];
        REAL flat;  // cosine between the direction and the normal; 0: neither a face nor a cap

        CUDA_CALLABLE inline void get(int i, REAL* x) const
        {
            if (i >= count) i -= count;
            if (corners) {
                turned(turn, corner + 3 * loop[begin + (i * corners) / count], x);
                UNROLL
                for (int r = 0; r < 3; ++r) x[r] += middle[r];
                return;
            }
            const REAL s = count == 8 ? eighth(i) : count == 4 ? (i == 0 || i == 3 ? 1 : -1) : i == 0 ? 1 : -1;
            const REAL t = count == 8 ? eighth((i + 6) & 7) : count == 4 ? (i < 2 ? 1 : -1) : 0;
            UNROLL
            for (int r = 0; r < 3; ++r) x[r] = count == 1 ? middle[r] : middle[r] + s * u[r] + t * v[r];
        }

        static CUDA_CALLABLE inline REAL eighth(int i)
        {
            const REAL x = i & 1 ? (REAL)0.70710678118654752 : i == 2 || i == 6 ? 0 : 1;
            return i > 2 && i < 6 ? -x : x;
        }

        // From the shape's axes to others.
        CUDA_CALLABLE inline void move(const REAL* turning, const REAL* at)
        {
            REAL x[3], y[3], z[3], n[3];
            turned(turning, middle, x);
            turned(turning, u, y);
            turned(turning, v, z);
            turned(turning, normal, n);
            UNROLL
            for (int r = 0; r < 3; ++r) {
                middle[r] = x[r] + at[r];
                u[r] = y[r];
                v[r] = z[r];
                normal[r] = n[r];
            }
            UNROLL
            for (int r = 0; r < 9; ++r) turn[r] = turning[r];
        }
    };

    static CUDA_CALLABLE inline Feature facing(const Shape& shape, const Tables& tables, const REAL* d)
    {
        Feature f;
        f.count = 1;
        f.begin = f.corners = 0;
        f.corner = tables.corner;
        f.loop = tables.loop;
        f.flat = 0;
        UNROLL
        for (int r = 0; r < 3; ++r) f.middle[r] = f.u[r] = f.v[r] = 0;
        UNROLL
        for (int r = 0; r < 3; ++r) f.normal[r] = d[r];
        UNROLL
        for (int r = 0; r < 9; ++r) f.turn[r] = r % 4 == 0;
        if (shape.kind == ELLIPSOID) support(shape, tables, d, f.middle);
        if (shape.kind == CAPSULE) {
            f.count = 2;
            f.u[2] = shape.size[2];
        }
        if (shape.kind == CYLINDER) {
            const REAL across = sqrt(d[0] * d[0] + d[1] * d[1]), sign = d[2] < 0 ? -1 : 1;
            const REAL x = across > (REAL)1e-6 ? d[0] / across : 1, y = across > (REAL)1e-6 ? d[1] / across : 0;
            const bool cap = across < (REAL)0.7;
            f.count = cap ? 8 : 2;
            f.middle[0] = cap ? 0 : shape.size[0] * x;
            f.middle[1] = cap ? 0 : shape.size[0] * y;
            f.middle[2] = cap ? sign * shape.size[2] : 0;
            f.u[0] = cap ? shape.size[0] * x : 0;
            f.u[1] = cap ? shape.size[0] * y : 0;
            f.u[2] = cap ? 0 : shape.size[2];
            f.v[0] = cap ? -sign * f.u[1] : 0;
            f.v[1] = cap ? sign * f.u[0] : 0;
            f.normal[0] = cap ? 0 : x;
            f.normal[1] = cap ? 0 : y;
            f.normal[2] = cap ? sign : 0;
            f.flat = cap ? size_of(d[2]) : 0;
        }
        if (shape.kind == BOX) {
            const REAL x = size_of(d[0]), y = size_of(d[1]), z = size_of(d[2]);
            const int axis = x >= y && x >= z ? 0 : y >= z ? 1 : 2;
            const REAL sign = (axis == 0 ? d[0] : axis == 1 ? d[1] : d[2]) < 0 ? -1 : 1;
            f.count = 4;
            UNROLL
            for (int r = 0; r < 3; ++r) {
                f.middle[r] = r == axis ? sign * shape.size[r] : 0;
                f.normal[r] = r == axis ? sign : 0;
                f.u[r] = r == (axis + 1) % 3 ? shape.size[r] : 0;
                f.v[r] = r == (axis + 2) % 3 ? sign * shape.size[r] : 0;
            }
            f.flat = axis == 0 ? x : axis == 1 ? y : z;
        }
        if (shape.kind == HULL) {
            int best = shape.face;
            f.flat = -2;
            LOOP
            for (int face = shape.face; face < shape.face + shape.faces; ++face) {
                const REAL cosine = dot(tables.plane + 4 * face, d);
                best = cosine > f.flat ? face : best;
                f.flat = cosine > f.flat ? cosine : f.flat;
            }
            UNROLL
            for (int r = 0; r < 3; ++r) f.normal[r] = tables.plane[4 * best + r];
            f.corner = tables.corner + 3 * shape.corner;
            f.begin = tables.first[best];
            f.corners = tables.first[best + 1] - f.begin;
            f.count = f.corners < LARGEST_FACE ? f.corners : LARGEST_FACE;
        }
        return f;
    }
"""
