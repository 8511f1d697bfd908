"""Native code of a warp on the host: 32 threads that wait for each other wherever lanes exchange values.

Products of tensor cores are those that PTX describes for mma.m16n8k8 of tf32 and mma.m16n8k16 of f16: exact products
and their sum, rounded once to float32.
"""

import shutil
import subprocess

import numpy as np
import pytest

HOST = r"""
#include <barrier>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <thread>
#include <vector>
#define __device__
struct Index { int x; };
thread_local Index threadIdx;
struct float2 { float x, y; };
struct uint4 { unsigned x, y, z, w; };
static std::barrier<> lanes(32);
static float values[32];
static unsigned a_of[32][4], b_of[32][2];
static float __fmaf_rn(float a, float b, float c) { return fmaf(a, b, c); }
template <class To, class From> static To same_bits(From x) { To y; memcpy(&y, &x, sizeof y); return y; }
static unsigned __float_as_uint(float x) { return same_bits<unsigned>(x); }
static float __uint_as_float(unsigned x) { return same_bits<float>(x); }
static float of_lane(float x, int lane)
{
    lanes.arrive_and_wait(); values[threadIdx.x] = x; lanes.arrive_and_wait();
    return values[lane];
}
#define __shfl_xor_sync(mask, given, bits) of_lane(given, threadIdx.x ^ (bits))
#define __shfl_sync(mask, given, lane_of) of_lane(given, lane_of)
static float part(unsigned word, int k) { return (float)same_bits<_Float16>((uint16_t)(k ? word >> 16 : word)); }
struct on_tensor_cores
{
    template <class Term>
    static void multiply(float* c, const unsigned* a, unsigned b0, unsigned b1, int depth, Term term)
    {
        const int lane = threadIdx.x;
        lanes.arrive_and_wait();
        for (int i = 0; i < 4; ++i) a_of[lane][i] = a[i];
        b_of[lane][0] = b0; b_of[lane][1] = b1;
        lanes.arrive_and_wait();
        for (int i = 0; i < 4; ++i) {
            double sum = c[i];
            for (int k = 0; k < depth; ++k) sum += term(lane / 4 + 8 * (i / 2), 2 * (lane % 4) + i % 2, k);
            c[i] = (float)sum;
        }
    }
    static void tf32(float* c, const unsigned* a, unsigned b0, unsigned b1)
    {
        multiply(c, a, b0, b1, 8, [](int row, int column, int k) {
            const unsigned x = a_of[row % 8 * 4 + k % 4][row / 8 + 2 * (k / 4)], y = b_of[column * 4 + k % 4][k / 4];
            return (double)__uint_as_float(x & 0xffffe000u) * __uint_as_float(y & 0xffffe000u);
        });
    }
    static void half(float* c, const unsigned* a, unsigned b0, unsigned b1)
    {
        multiply(c, a, b0, b1, 16, [](int row, int column, int k) {
            const unsigned x = a_of[row % 8 * 4 + k % 8 / 2][row / 8 + 2 * (k / 8)];
            const unsigned y = b_of[column * 4 + k % 8 / 2][k / 8];
            return (double)part(x, k % 2) * part(y, k % 2);
        });
    }
    static unsigned to_half(float low, float high)
    {
        return same_bits<uint16_t>((_Float16)low) | (unsigned)same_bits<uint16_t>((_Float16)high) << 16;
    }
    static void from_half(unsigned word, float& low, float& high) { low = part(word, 0); high = part(word, 1); }
    static float over(float x) { return 1.0f / x; }
};
"""
MAIN = r"""
int main()
{
    std::vector<float> weights(WEIGHTS), staged(STAGED), found(32 * JOINTS);
    if (fread(weights.data(), 4, WEIGHTS, stdin) + fread(staged.data(), 4, STAGED, stdin) != WEIGHTS + STAGED) return 1;
    std::vector<std::thread> threads;
    for (int lane = 0; lane < 32; ++lane)
        threads.emplace_back([&, lane] {
            threadIdx.x = lane;
            for (int joint = 0; joint < JOINTS; ++joint) {
                float sums[4];
                network::tiles(staged.data() + joint * (STAGED / JOINTS), weights.data(), sums);
                found[32 * joint + lane / 4 + 8 * (lane % 4)] = sums[lane % 4];
            }
        });
    for (auto& each : threads) each.join();
    fwrite(found.data(), 4, found.size(), stdout);
}
"""


def run_network(definition, weights, staged, folder):
    """Return what ``network::tile`` of a definition finds [joint, row], from ``staged`` [joint, input, PITCH]."""
    if shutil.which("g++") is None:
        pytest.skip("there is no g++ to compile device code for the host")
    sizes = {"WEIGHTS": weights.size, "STAGED": staged.size, "JOINTS": len(staged)}
    constants = "".join(f"constexpr size_t {name} = {size};\n" for name, size in sizes.items())
    (folder / "warp.cpp").write_text(HOST + constants + definition + MAIN)
    options = ["-O1", "-std=c++20", "-ffp-contract=off", "-w", "-pthread"]
    subprocess.run(["g++", *options, "warp.cpp", "-o", "warp"], cwd=folder, check=True)
    given = np.concatenate([weights, staged.ravel()]).astype(np.float32).tobytes()
    done = subprocess.run([folder / "warp"], input=given, capture_output=True, check=True, timeout=300)
    return np.frombuffer(done.stdout, np.float32).reshape(len(staged), 32)
