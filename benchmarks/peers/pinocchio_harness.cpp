// Times Pinocchio's templated algorithms on one core and on all cores, without Python. The model and the states come from
// files. Compile with g++ -O3 -fopenmp -DSCALAR=double (pinocchio_cpu.py has the whole command); this takes minutes.
//
//   pinocchio_harness MODEL STATES RESULTS SECONDS WORLDS...
//
// The formats of MODEL and STATES are described in exchange.py. Each case prints one JSON line. RESULTS gets, for each case,
// a block for each set of states, evaluated into memory filled with NaN, and a block with the results of the timed run. A
// block has the worlds that sample() in coordinates.py chooses.
#include <omp.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/multibody.hpp>
#include <string>
#include <vector>

namespace pin = pinocchio;

static void fail(const char *what) {
  std::fprintf(stderr, "pinocchio_harness: %s\n", what);
  std::exit(1);
}

using T = SCALAR;
using Model = pin::ModelTpl<T>;
using Data = pin::DataTpl<T>;
using Vector = Eigen::Matrix<T, Eigen::Dynamic, 1>;
using In = Eigen::Map<const Vector>;

template <template <typename, int, int> class Joint, typename Unaligned>
static pin::JointModelTpl<T> along(const Eigen::Matrix<T, 3, 1> &axis) {
  for (int i = 0; i < 3; ++i)
    if (axis == Eigen::Matrix<T, 3, 1>::Unit(i))
      return i == 0   ? pin::JointModelTpl<T>(Joint<T, 0, 0>())
             : i == 1 ? pin::JointModelTpl<T>(Joint<T, 0, 1>())
                      : pin::JointModelTpl<T>(Joint<T, 0, 2>());
  return pin::JointModelTpl<T>(Unaligned(axis));
}

// links [parent, kind, R (9), p (3), axis (3), mass, com (3), J (9)], in float64; kind 0 revolute, 1 prismatic, 2 free
static Model read_model(const char *path) {
  FILE *file = std::fopen(path, "rb");
  int32_t links;
  double gravity[3];
  if (!file || std::fread(&links, 4, 1, file) != 1 || std::fread(gravity, 8, 3, file) != 3) fail("there is no file of a model");
  Model model;
  auto vector = [](double *x) -> Eigen::Matrix<T, 3, 1> { return Eigen::Map<Eigen::Vector3d>(x).cast<T>(); };
  auto matrix = [](double *x) -> Eigen::Matrix<T, 3, 3> {
    return Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(x).cast<T>();
  };
  model.gravity.linear() = vector(gravity);
  for (int k = 0; k < links; ++k) {
    double x[30];
    if (std::fread(x, 8, 30, file) != 30) fail("a short model");
    const auto joint = x[1] == 2   ? pin::JointModelTpl<T>(pin::JointModelFreeFlyerTpl<T>())
                       : x[1] == 1 ? along<pin::JointModelPrismaticTpl, pin::JointModelPrismaticUnalignedTpl<T>>(vector(x + 14))
                                   : along<pin::JointModelRevoluteTpl, pin::JointModelRevoluteUnalignedTpl<T>>(vector(x + 14));
    const auto id = model.addJoint(pin::JointIndex(x[0] + 1), joint, pin::SE3Tpl<T>(matrix(x + 2), vector(x + 11)),
                                   "joint_" + std::to_string(k));
    const pin::InertiaTpl<T> inertia(T(x[17]), vector(x + 18), pin::Symmetric3Tpl<T>(matrix(x + 21)));
    model.appendBodyToJoint(id, inertia, pin::SE3Tpl<T>::Identity());
  }
  std::fclose(file);
  return model;
}

struct Bench {
  struct Set {
    std::vector<T> q, qd, tau, qdd;
  };

  Model model;
  std::vector<Set> sets;
  int all;

  void run(FILE *file, FILE *results, int count, int nq, double seconds, const std::vector<int> &worlds_list) {
    const int nv = model.nv;
    if (nq != model.nq) fail("the files are missing, or the states belong to another robot or precision");
    auto read = [&](int n) {
      std::vector<T> values(size_t(all) * n);
      if (std::fread(values.data(), sizeof(T), values.size(), file) != values.size()) fail("short states");
      return values;
    };
    for (int i = 0; i < count; ++i) {
      Set set;
      set.q = read(nq), set.qd = read(nv), set.tau = read(nv), set.qdd = read(nv);
      sets.push_back(std::move(set));
    }
    size_t offset = 0;
    auto forward = [&](Data &data, const Set &s, size_t w, T *out) {
      Eigen::Map<Vector>(out, nv) = pin::aba(model, data, In(&s.q[w * nq], nq), In(&s.qd[w * nv], nv),
                                             In(&s.tau[w * nv], nv), pin::Convention::LOCAL);
    };
    auto inverse = [&](Data &data, const Set &s, size_t w, T *out) {
      Eigen::Map<Vector>(out, nv) =
          pin::rnea(model, data, In(&s.q[w * nq], nq), In(&s.qd[w * nv], nv), In(&s.qdd[w * nv], nv));
    };
    auto mass = [&](Data &data, const Set &s, size_t w, T *out) {
      pin::crba(model, data, In(&s.q[w * nq], nq), pin::Convention::LOCAL);
      using Square = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic>;
      Eigen::Map<Square>(out, nv, nv) = data.M.selfadjointView<Eigen::Upper>();
    };
    measure("forward_dynamics", nv, forward, worlds_list, seconds, results, offset);
    measure("inverse_dynamics", nv, inverse, worlds_list, seconds, results, offset);
    measure("mass_matrix", nv * nv, mass, worlds_list, seconds, results, offset);
  }

  template <typename F>
  void measure(const char *op, int size, F one, const std::vector<int> &worlds_list, double seconds, FILE *results,
               size_t &offset) {
    const int most = omp_get_max_threads();
    std::vector<Data> data(most, Data(model));
    for (int threads : {1, most}) {
      for (int worlds : worlds_list) {
        if (threads > 1 && worlds < 2) continue;
        if (threads == 1 && worlds > 4096) {
          std::printf("{\"op\": \"%s\", \"variant\": \"one core\", \"worlds\": %d, \"skipped\": \"time is proportional to "
                      "worlds\"}\n", op, worlds);
          continue;
        }
        std::vector<T> out(size_t(worlds) * size);
        auto evaluate = [&](const Set &set) {
          if (threads == 1) {
            for (int w = 0; w < worlds; ++w) one(data[0], set, w, &out[size_t(w) * size]);
          } else {
#pragma omp parallel for schedule(static) num_threads(threads)
            for (int w = 0; w < worlds; ++w) one(data[omp_get_thread_num()], set, w, &out[size_t(w) * size]);
          }
        };
        std::vector<int> sample = {0, std::min(1, worlds - 1), worlds / 2, worlds - 1};
        std::sort(sample.begin(), sample.end());
        sample.erase(std::unique(sample.begin(), sample.end()), sample.end());
        auto keep = [&] {
          for (int w : sample) std::fwrite(&out[size_t(w) * size], sizeof(T), size, results);
        };
        auto poison = [&] { std::fill(out.begin(), out.end(), std::numeric_limits<T>::quiet_NaN()); };
        for (const Set &set : sets) poison(), evaluate(set), keep();
        using clock = std::chrono::steady_clock;
        auto row = [&](int rounds) {
          const auto begin = clock::now();
          for (int round = 0; round < rounds; ++round)
            for (const Set &set : sets) evaluate(set);
          return std::chrono::duration<double, std::micro>(clock::now() - begin).count() / (rounds * sets.size());
        };
        const double once = std::max(row(1), 0.01);
        // One repeat takes a twentieth of the time; there are at least 5 repeats.
        const int rounds = std::max(1, int(seconds * 1e6 / 20 / (once * sets.size())));
        const int repeats = std::clamp(int(seconds * 1e6 / (once * sets.size() * rounds)), 5, 20);
        poison();
        std::vector<double> us;
        for (int i = 0; i < repeats; ++i) us.push_back(row(rounds));
        std::sort(us.begin(), us.end());
        keep();
        std::printf("{\"op\": \"%s\", \"variant\": \"%s\", \"worlds\": %d, \"us\": %.6g, \"p10_us\": %.6g, \"p90_us\": %.6g, "
                    "\"offset\": %zu, \"size\": %d, \"config\": \"%d thread%s\"}\n",
                    op, threads == 1 ? "one core" : "all cores", worlds, us[us.size() / 2], us[us.size() / 10],
                    us[us.size() * 9 / 10], offset, size, threads, threads == 1 ? "" : "s");
        std::fflush(stdout);
        offset += (sets.size() + 1) * sample.size() * size;
      }
      if (most == 1) break;
    }
  }
};

int main(int argc, char **argv) {
  if (argc < 6) return std::fprintf(stderr, "pinocchio_harness MODEL STATES RESULTS SECONDS WORLDS...\n"), 2;
  const Model model = read_model(argv[1]);
  FILE *file = std::fopen(argv[2], "rb"), *results = std::fopen(argv[3], "wb");
  int32_t head[5];  // bytes of a number, sets, worlds, nq, nv
  if (!file || !results || std::fread(head, 4, 5, file) != 5 || head[0] != sizeof(T) ||
      head[4] != model.nv) fail("the files are missing, or the states belong to another robot or precision");
  std::vector<int> worlds;
  for (int i = 5; i < argc; ++i) worlds.push_back(std::atoi(argv[i]));
  Bench bench{model, {}, head[2]};
  bench.run(file, results, head[1], head[3], std::atof(argv[4]), worlds);
  std::fclose(results);
  return 0;
}
