// Times GRiD's generated kernels of one robot as the benchmarks time ours: several evaluations in one CUDA graph, which
// cycle through the sets of inputs; median of replays. Compile: nvcc -DGRID_HEADER='"panda.cuh"' (see grid.py).
//
//   grid_harness STATES RESULTS GRAVITY SECONDS WORLDS...     GRAVITY along z, -9.81 on Earth
//
// The format of STATES is described in exchange.py. Each case prints one JSON line. RESULTS gets, for each case, a block
// for each set of states, evaluated into memory filled with NaN, and a block with the results of the timed run. A block
// has the worlds that sample() in coordinates.py chooses. Each world has one block of threads. All resource tiers and
// numbers of threads are tried first, and the fastest combination is timed.
#include GRID_HEADER

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <string>
#include <vector>

#define CHECK(call)                                                                                  \
  do {                                                                                               \
    cudaError_t code = (call);                                                                       \
    if (code != cudaSuccess) {                                                                       \
      std::fprintf(stderr, "%s:%d: %s: %s\n", __FILE__, __LINE__, #call, cudaGetErrorString(code));  \
      std::exit(1);                                                                                  \
    }                                                                                                \
  } while (0)

using T = float;
constexpr int NQ = grid::NUM_JOINTS, NV = grid::NUM_VEL;  // GRiD pads velocities of a floating robot to NQ
constexpr int STRIDE = 3 * NQ;                            // q, qd, u of one world
constexpr int SLOTS = 132 * 16;                           // blocks that have workspace in the lighter tiers

struct Set {
  T *state, *qdd;  // [world, STRIDE], [world, NQ]
};
struct Config {
  int tier, threads;
};
using Launch = std::function<bool(Config, const Set &, T *out, int worlds, cudaStream_t)>;
struct Op {
  const char *name, *variant;
  int size;    // entries of a result in one world
  int stride;  // entries of a result in one world as GRiD stores it
  bool tiers;
  Launch launch;
};

static const grid::robotModel<T> *model;
static unsigned char *workspace;
static T gravity;

template <typename Kernel, typename... Args>
bool start(Kernel kernel, size_t shared, int blocks, int threads, cudaStream_t stream, Args... args) {
  cudaFuncAttributes attributes;
  CHECK(cudaFuncGetAttributes(&attributes, kernel));
  if (threads > attributes.maxThreadsPerBlock) return false;
  if (shared > 232448 || cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, int(shared)) != cudaSuccess) {
    cudaGetLastError();
    return false;
  }
  kernel<<<blocks, threads, shared, stream>>>(args...);
  return cudaGetLastError() == cudaSuccess;
}

template <int TIER>
bool aba(Config c, const Set &in, T *out, int worlds, cudaStream_t s) {
  int blocks = TIER == grid::TIER_SHARED ? worlds : std::min(worlds, SLOTS);
  return start(grid::aba_kernel<T, TIER>, grid::ABA_DYNAMIC_SHARED_MEM_BYTES<T, TIER>(), blocks, c.threads, s, out, workspace,
               (const T *)in.state, STRIDE, (T *)nullptr, model, gravity, worlds);
}
template <int TIER>
bool minv(Config c, const Set &in, T *out, int worlds, cudaStream_t s) {
  int blocks = TIER == grid::TIER_SHARED ? worlds : std::min(worlds, SLOTS);
  return start(grid::forward_dynamics_kernel<T, TIER>, grid::FORWARD_DYNAMICS_DYNAMIC_SHARED_MEM_BYTES<T, TIER>(), blocks,
               c.threads, s, out, workspace, (const T *)in.state, STRIDE, (T *)nullptr, model, gravity, worlds);
}
template <int TIER>
bool crba(Config c, const Set &in, T *out, int worlds, cudaStream_t s) {
  int blocks = TIER == grid::TIER_SHARED ? worlds : std::min(worlds, SLOTS);
  return start(grid::crba_kernel<T, TIER>, grid::CRBA_DYNAMIC_SHARED_MEM_BYTES<T, TIER>(), blocks, c.threads, s, out, workspace,
               (const T *)in.state, STRIDE, model, gravity, worlds);
}
bool rnea(Config c, const Set &in, T *out, int worlds, cudaStream_t s) {
  using Kernel = void (*)(T *, const T *, const int, const T *, T *, const grid::robotModel<T> *, const T, const int);
  return start((Kernel)&grid::inverse_dynamics_kernel<T>, grid::INVERSE_DYNAMICS_DYNAMIC_SHARED_MEM_BYTES<T>(), worlds,
               c.threads, s, out, (const T *)in.state, STRIDE, (const T *)in.qdd, (T *)nullptr, model, gravity, worlds);
}

#define BY_TIER(function)                                                                  \
  [](Config c, const Set &in, T *out, int worlds, cudaStream_t s) {                        \
    return c.tier == grid::TIER_SHARED ? function<grid::TIER_SHARED>(c, in, out, worlds, s) \
                                       : function<grid::TIER_LITE>(c, in, out, worlds, s);  \
  }

static std::vector<double> replay(const Op &op, Config c, const std::vector<Set> &sets, T *out, int worlds, int rounds,
                                  int repeats, cudaStream_t stream) {
  cudaGraph_t graph;
  cudaGraphExec_t executable;
  CHECK(cudaStreamBeginCapture(stream, cudaStreamCaptureModeThreadLocal));
  for (int round = 0; round < rounds; ++round)
    for (const Set &set : sets) op.launch(c, set, out, worlds, stream);
  CHECK(cudaStreamEndCapture(stream, &graph));
  CHECK(cudaGraphInstantiate(&executable, graph, 0));
  cudaEvent_t begin, end;
  CHECK(cudaEventCreate(&begin));
  CHECK(cudaEventCreate(&end));
  std::vector<double> us;
  for (int i = -2; i < repeats; ++i) {
    CHECK(cudaEventRecord(begin, stream));
    CHECK(cudaGraphLaunch(executable, stream));
    CHECK(cudaEventRecord(end, stream));
    CHECK(cudaEventSynchronize(end));
    float ms;
    CHECK(cudaEventElapsedTime(&ms, begin, end));
    if (i >= 0) us.push_back(1e3 * ms / (rounds * sets.size()));
  }
  CHECK(cudaEventDestroy(begin));
  CHECK(cudaEventDestroy(end));
  CHECK(cudaGraphExecDestroy(executable));
  CHECK(cudaGraphDestroy(graph));
  std::sort(us.begin(), us.end());
  return us;
}

int main(int argc, char **argv) {
  if (argc < 6) return std::fprintf(stderr, "grid_harness STATES RESULTS GRAVITY SECONDS WORLDS...\n"), 2;
  FILE *file = std::fopen(argv[1], "rb"), *results = std::fopen(argv[2], "wb");
  int32_t head[5];  // bytes of a number, sets, worlds, nq, nv
  if (!file || !results || std::fread(head, 4, 5, file) != 5 || head[0] != sizeof(T) || head[4] != NV)
    return std::fprintf(stderr, "grid_harness: states that are not this robot's\n"), 1;
  const int count = head[1], all = head[2], nq = head[3];
  gravity = T(std::atof(argv[3]));
  const double seconds = std::atof(argv[4]);

  auto read = [&](int n) {
    std::vector<T> values(size_t(all) * n);
    if (std::fread(values.data(), sizeof(T), values.size(), file) != values.size()) std::exit(1);
    return values;
  };
  std::vector<Set> sets(count);
  for (Set &set : sets) {
    std::vector<T> q = read(nq), qd = read(NV), tau = read(NV), qdd = read(NV);
    std::vector<T> state(size_t(all) * STRIDE), padded(size_t(all) * NQ);
    for (int w = 0; w < all; ++w) {
      std::copy_n(&q[size_t(w) * nq], nq, &state[size_t(w) * STRIDE]);
      std::copy_n(&qd[size_t(w) * NV], NV, &state[size_t(w) * STRIDE + NQ]);
      std::copy_n(&tau[size_t(w) * NV], NV, &state[size_t(w) * STRIDE + 2 * NQ]);
      std::copy_n(&qdd[size_t(w) * NV], NV, &padded[size_t(w) * NQ]);
    }
    CHECK(cudaMalloc(&set.state, state.size() * sizeof(T)));
    CHECK(cudaMalloc(&set.qdd, padded.size() * sizeof(T)));
    CHECK(cudaMemcpy(set.state, state.data(), state.size() * sizeof(T), cudaMemcpyHostToDevice));
    CHECK(cudaMemcpy(set.qdd, padded.data(), padded.size() * sizeof(T), cudaMemcpyHostToDevice));
  }
  T *out;
  const size_t out_bytes = size_t(all) * std::max(NQ, NV * NV) * sizeof(T);
  CHECK(cudaMalloc(&out, out_bytes));
  CHECK(cudaMalloc(&workspace, grid::GRID_WORKSPACE_BYTES_PER_TIMESTEP<T>() * size_t(std::min(all, SLOTS))));
  model = grid::init_robotModel<T>();
  cudaStream_t stream;
  CHECK(cudaStreamCreate(&stream));

  const std::vector<Op> ops = {
      {"forward_dynamics", "aba", NV, NQ, true, BY_TIER(aba)},
      {"forward_dynamics", "minv", NV, NQ, true, BY_TIER(minv)},
      {"inverse_dynamics", "rnea", NV, NQ, false, rnea},
      {"mass_matrix", "crba", NV * NV, NV * NV, true, BY_TIER(crba)},
  };
  size_t offset = 0;
  for (const Op &op : ops) {
    for (int arg = 5; arg < argc; ++arg) {
      const int worlds = std::atoi(argv[arg]);
      std::vector<int> sample = {0, std::min(1, worlds - 1), worlds / 2, worlds - 1};
      std::sort(sample.begin(), sample.end());
      sample.erase(std::unique(sample.begin(), sample.end()), sample.end());

      Config best{-1, 0};
      double fastest = INFINITY;
      std::string swept;
      for (int tier : {int(grid::TIER_SHARED), int(grid::TIER_LITE)})
        for (int threads : {32, 64, 96, 128, 192, 256, 384, 512}) {
          Config c{tier, threads};
          if (tier != grid::TIER_SHARED && !op.tiers) continue;
          CHECK(cudaMemsetAsync(out, 0xff, out_bytes, stream));
          if (!op.launch(c, sets[0], out, worlds, stream)) continue;
          CHECK(cudaStreamSynchronize(stream));
          double us = replay(op, c, sets, out, worlds, 1, 3, stream)[0];
          char text[64];
          std::snprintf(text, sizeof text, "%s%d/%d:%.1f", swept.empty() ? "" : " ", tier, threads, us);
          swept += text;
          if (us < fastest) fastest = us, best = c;
        }
      if (best.tier < 0) {
        std::printf("{\"op\": \"%s\", \"variant\": \"%s\", \"worlds\": %d, \"skipped\": \"no launch fits\"}\n", op.name,
                    op.variant, worlds);
        continue;
      }
      std::vector<T> host(sample.size() * op.stride);
      auto keep = [&] {
        for (size_t i = 0; i < sample.size(); ++i)
          CHECK(cudaMemcpy(&host[i * op.stride], out + size_t(sample[i]) * op.stride, op.stride * sizeof(T), cudaMemcpyDeviceToHost));
        for (size_t i = 0; i < sample.size(); ++i) std::fwrite(&host[i * op.stride], sizeof(T), op.size, results);
      };
      for (const Set &set : sets) {
        CHECK(cudaMemsetAsync(out, 0xff, out_bytes, stream));
        op.launch(best, set, out, worlds, stream);
        CHECK(cudaStreamSynchronize(stream));
        keep();
      }
      CHECK(cudaMemsetAsync(out, 0xff, out_bytes, stream));
      const int rounds = int(std::clamp(seconds * 1e6 / (fastest * count), 1.0, 8.0));
      std::vector<double> us = replay(op, best, sets, out, worlds, rounds, 20, stream);
      CHECK(cudaStreamSynchronize(stream));
      keep();
      std::printf("{\"op\": \"%s\", \"variant\": \"%s\", \"worlds\": %d, \"us\": %.6g, \"p10_us\": %.6g, \"p90_us\": %.6g, "
                  "\"offset\": %zu, \"size\": %d, \"config\": \"%s, %d threads a block\", \"swept\": \"%s\"}\n",
                  op.name, op.variant, worlds, us[us.size() / 2], us[us.size() / 10], us[us.size() * 9 / 10], offset, op.size,
                  best.tier == grid::TIER_SHARED ? "TIER_SHARED" : "TIER_LITE", best.threads, swept.c_str());
      std::fflush(stdout);
      offset += (count + 1) * sample.size() * op.size;
    }
  }
  std::fclose(results);
  return 0;
}
