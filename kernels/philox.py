"""Philox 4x32-10: random numbers that are a function of a key and a counter, the same on every device.

Salmon, Moraes, Dror and Shaw 2011, "Parallel random numbers: as easy as 1, 2, 3", algorithm Philox4x32 with 10 rounds.
"""

NATIVE = r"""
struct philox
{
    static CUDA_CALLABLE inline void random(const unsigned int* key, const unsigned int* counter, unsigned int* out)
    {
        unsigned int k0 = key[0], k1 = key[1];
        unsigned int a = counter[0], b = counter[1], c = counter[2], d = counter[3];
#if defined(__CUDA_ARCH__)
        #pragma unroll
#endif
        for (int turn = 0; turn < 10; ++turn) {
            const unsigned long long x = 0xD2511F53ull * a, y = 0xCD9E8D57ull * c;
            a = (unsigned int)(y >> 32) ^ b ^ k0;
            b = (unsigned int)y;
            c = (unsigned int)(x >> 32) ^ d ^ k1;
            d = (unsigned int)x;
            k0 += 0x9E3779B9u;
            k1 += 0xBB67AE85u;
        }
        out[0] = a; out[1] = b; out[2] = c; out[3] = d;
    }

    static CUDA_CALLABLE inline float unit(unsigned int word) { return (float)(word >> 8) * 5.9604644775390625e-8f; }

    static CUDA_CALLABLE inline float uniform(const unsigned int* key, const unsigned int* first, int block, int i)
    {
        const unsigned int counter[4] = {first[0], first[1], first[2], first[3] + block};
        unsigned int word[4];
        random(key, counter, word);
        return unit(word[i]);
    }
};
"""
"""``philox::random(key, counter, out)``: four random words of 32 bits. ``philox::uniform``: one number in [0, 1)."""


def draws(
    count: int, seed: tuple[str, str], stream: int, world: str, step: str, first: str = "0", late: bool = False
) -> str:
    """Return code after which ``DRAW(i)``, i a literal below ``count``, is a number in [0, 1), a multiple of 2^-24.

    Args:
        count: how many.
        seed: C++ of two words, the key. stream: a number that tells kernels of one seed apart.
        world: C++ of the world's number in the whole run. step: C++ of the number of the step; both 32 bits.
        first: C++ of the last word of the counter of the first four numbers.
        late: each is computed where it is used, in a branch that few threads enter; otherwise all come first, four with
            one counter: observing 65,536 Go2 takes 22 us so, and 31 where each is computed by itself.
    """
    if not count:
        return ""
    blocks = -(-count // 4)
    each = "#define DRAW(i) philox::uniform(own_key, own_counter, (i) / 4, (i) % 4)"
    all_first = f"""float draw[{4 * blocks}];
#if defined(__CUDA_ARCH__)
#pragma unroll
#endif
for (int block = 0; block < {blocks}; ++block) {{
    const unsigned int counter[4] = {{own_counter[0], own_counter[1], own_counter[2], own_counter[3] + block}};
    unsigned int word[4];
    philox::random(own_key, counter, word);
    for (int i = 0; i < 4; ++i) draw[4 * block + i] = philox::unit(word[i]);
}}
#define DRAW(i) draw[i]"""
    return f"""{NATIVE}
const unsigned int own_key[2] = {{{seed[0]}, {seed[1]}}};
const unsigned int own_counter[4] = {{
    (unsigned int)({world}), (unsigned int)({step}), {stream}u, (unsigned int)({first})}};
{each if late else all_first}
"""


UNDEFINE = "#undef DRAW"
