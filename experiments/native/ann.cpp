// The searches of the thesis with the ANN library (D. M. Mount, S. Arya, ANN 1.1.2), as a C interface. Build: experiments/_native.py.
#include <ANN/ANN.h>

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

namespace {

using Pair = std::pair<int32_t, int32_t>;

enum Processing { NO_LIST = 0, SANE = 1, NAIVE = 2 };

double now() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

// Appends the pairs of particle i that are not in the list yet.
// NAIVE looks for each of them in the whole list so far: quadratic in the number of pairs. SANE uses that every pair is met from either
// side, so that the smaller index alone need note it.
void append(int32_t i, const int* found, int count, Processing how, std::vector<Pair>& pairs) {
  for (int k = 0; k < count; ++k) {
    const int32_t j = found[k];
    if (how == SANE) {
      if (i < j) pairs.emplace_back(i, j);
    } else if (i != j) {
      const Pair pair = std::minmax(i, j);
      if (std::find(pairs.begin(), pairs.end(), pair) == pairs.end()) pairs.push_back(pair);
    }
  }
}

}  // namespace

extern "C" {

// Builds a tree (bd: 0 kd, 1 bd) of `points`, shape [n, dim], then counts the neighbors of each point, fetches them, and lists pairs.
// `counts_out`, shape [n], gets the neighbors of each particle, itself included; `seconds_out`, shape [4], the times of tree, count,
// fetch and list. Returns the list, for `pairs_size`, `pairs_data` and `pairs_release`.
void* ann_search(const double* points, int32_t n, int32_t dim, double cutoff, int32_t bd, int32_t processing, int32_t* counts_out,
                 double* seconds_out) {
  const auto how = static_cast<Processing>(processing);
  const double start = now();
  std::vector<ANNpoint> rows(n);
  for (int32_t i = 0; i < n; ++i) rows[i] = const_cast<double*>(points) + int64_t(i) * dim;
  std::unique_ptr<ANNkd_tree> tree(bd ? new ANNbd_tree(rows.data(), n, dim) : new ANNkd_tree(rows.data(), n, dim));
  double last = now();
  seconds_out[0] = last - start;
  seconds_out[1] = seconds_out[2] = seconds_out[3] = 0.0;
  std::vector<int> found;
  std::vector<double> squares;
  auto* pairs = new std::vector<Pair>;
  for (int32_t i = 0; i < n; ++i) {
    counts_out[i] = tree->annkFRSearch(rows[i], cutoff * cutoff, 0);
    const double counted = now();
    found.resize(counts_out[i]);
    squares.resize(counts_out[i]);
    tree->annkFRSearch(rows[i], cutoff * cutoff, counts_out[i], found.data(), squares.data());
    const double fetched = now();
    if (how != NO_LIST) append(i, found.data(), counts_out[i], how, *pairs);
    seconds_out[1] += counted - last;
    seconds_out[2] += fetched - counted;
    last = now();
    seconds_out[3] += last - fetched;
  }
  tree.reset();
  annClose();
  return pairs;
}

int64_t pairs_size(const void* pairs) { return static_cast<int64_t>(static_cast<const std::vector<Pair>*>(pairs)->size()); }

const int32_t* pairs_data(const void* pairs) { return &static_cast<const std::vector<Pair>*>(pairs)->data()->first; }

void pairs_release(void* pairs) { delete static_cast<std::vector<Pair>*>(pairs); }
}
