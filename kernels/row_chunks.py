"""Long rows of results, one a world, which a warp writes side by side: 64 entries of 32 worlds at a time.

A thread that writes its own row touches 32 bytes of memory for each 4. Here the threads of a warp leave their entries
in shared memory, and then write each world's part of the row together.
"""

CHUNK = 64  # entries of a row
PITCH = CHUNK + 1  # scalars between rows in shared memory, odd against bank conflicts
WARP = 32


STORES = """
#define SET(place, value) place = (value)
#if defined(__CUDA_ARCH__)
#define SET_PASSING(place, value) __stcs(&(place), value)
#else
#define SET_PASSING(place, value) place = (value)
#endif
"""
"""``SET(place, value)`` stores; ``SET_PASSING`` stores what is to leave the caches before everything else."""


def define(block: int) -> str:
    """Return the definitions of PUT and FLUSH, for blocks of so many threads, of which each has one world.

    ``BEGIN(start)`` comes before the entries from ``start`` on. ``PUT(name, entries, entry, value)`` sets an entry of
    the own row of the array ``name`` [world, entries]. ``FLUSH(name, entries, start, count, set)`` writes the entries
    from ``start`` on; all that were put since BEGIN must be of these ``count``, at most 64. ``set`` is SET or
    SET_PASSING of :data:`STORES`, which must come before.
    """
    return f"""
#if defined(__CUDA_ARCH__)
__shared__ float chunks[{block * PITCH}];
float* own_chunk = chunks + threadIdx.x * {PITCH};
const int lane = threadIdx.x & 31;
const float* chunks_of_warp = own_chunk - lane * {PITCH};
const long long first_world = (long long)thread - lane;
const int worlds_of_warp = worlds - first_world < {WARP} ? (int)(worlds - first_world) : {WARP};
int first_entry = 0;
#define BEGIN(start) first_entry = start;
#define PUT(name, entries, entry, value) own_chunk[(entry) - first_entry] = (value);
#define FLUSH(name, entries, start, count, set) \\
    __syncwarp(); \\
    for (int i = lane; i < worlds_of_warp * (count); i += {WARP}) \\
        set(name.data[(first_world + i / (count)) * (entries) + (start) + i % (count)], \\
            chunks_of_warp[i / (count) * {PITCH} + i % (count)]); \\
    __syncwarp();
#else
#define BEGIN(start)
#define PUT(name, entries, entry, value) name.data[world * (entries) + (entry)] = (value);
#define FLUSH(name, entries, start, count, set)
#endif
"""


END_STORES = "#undef SET\n#undef SET_PASSING"
UNDEFINE = "#undef BEGIN\n#undef PUT\n#undef FLUSH"
