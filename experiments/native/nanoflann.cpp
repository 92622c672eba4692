// nanoflann (J. L. Blanco-Claraco) as a C interface: a kd-tree made anew, and its dynamic index. Build: experiments/_native.py.
#include <cstdint>
#include <nanoflann.hpp>
#include <utility>
#include <vector>

namespace {

using Pair = std::pair<int32_t, int32_t>;

// Rows of coordinates, the last of which may be followed by more.
struct Cloud {
  std::vector<double> rows;
  int32_t dim;

  size_t kdtree_get_point_count() const { return rows.size() / dim; }
  double kdtree_get_pt(size_t i, size_t axis) const { return rows[i * dim + axis]; }
  template <class Box>
  bool kdtree_get_bbox(Box&) const {
    return false;
  }
};

using Metric = nanoflann::L2_Simple_Adaptor<double, Cloud>;
using Static = nanoflann::KDTreeSingleIndexAdaptor<Metric, Cloud, -1, uint32_t>;
using Dynamic = nanoflann::KDTreeSingleIndexDynamicAdaptor<Metric, Cloud, -1, uint32_t>;

// Lists the pairs i < j of the last n points, which are the particles; the tree may hold older ones that it has been told to forget.
template <class Tree>
std::vector<Pair>* list_pairs(const Tree& tree, const Cloud& cloud, int32_t n, double cutoff) {
  auto* pairs = new std::vector<Pair>;
  const size_t first = cloud.kdtree_get_point_count() - n;
  std::vector<std::pair<uint32_t, double>> found;
  for (int32_t i = 0; i < n; ++i) {
    found.clear();
    nanoflann::RadiusResultSet<double, uint32_t> result(cutoff * cutoff, found);
    tree.findNeighbors(result, &cloud.rows[(first + i) * cloud.dim], nanoflann::SearchParams());
    for (const auto& neighbor : found) {
      const auto j = static_cast<int32_t>(neighbor.first - first);
      if (i < j) pairs->emplace_back(i, j);
    }
  }
  return pairs;
}

struct Follower {
  Cloud cloud;
  int32_t n;
  Dynamic tree;

  Follower(const double* points, int32_t n, int32_t dim)
      : cloud{{points, points + int64_t(n) * dim}, dim}, n(n), tree(dim, cloud, nanoflann::KDTreeSingleIndexAdaptorParams()) {}
};

}  // namespace

extern "C" {

// Builds a tree of `points`, shape [n, dim], and returns the list of pairs closer than the cutoff.
void* static_search(const double* points, int32_t n, int32_t dim, double cutoff) {
  const Cloud cloud{{points, points + int64_t(n) * dim}, dim};
  Static tree(dim, cloud, nanoflann::KDTreeSingleIndexAdaptorParams());
  tree.buildIndex();
  return list_pairs(tree, cloud, n, cutoff);
}

// Puts `points`, shape [n, dim], into a dynamic index.
void* dynamic_new(const double* points, int32_t n, int32_t dim) { return new Follower(points, n, dim); }

// Forgets where the particles were, and adds where they are. A point cannot be moved: its place is marked as gone, which stays in the
// trees, and the particle comes back as a new one.
void dynamic_move(void* handle, const double* points) {
  auto& [cloud, n, tree] = *static_cast<Follower*>(handle);
  const size_t last = cloud.kdtree_get_point_count();
  for (size_t old = last - n; old < last; ++old) tree.removePoint(old);
  cloud.rows.insert(cloud.rows.end(), points, points + int64_t(n) * cloud.dim);
  tree.addPoints(last, last + n - 1);
}

// Returns the list of pairs closer than the cutoff where the particles are.
void* dynamic_search(void* handle, double cutoff) {
  const auto& [cloud, n, tree] = *static_cast<Follower*>(handle);
  return list_pairs(tree, cloud, n, cutoff);
}

void dynamic_release(void* handle) { delete static_cast<Follower*>(handle); }

int64_t pairs_size(const void* pairs) { return static_cast<int64_t>(static_cast<const std::vector<Pair>*>(pairs)->size()); }

const int32_t* pairs_data(const void* pairs) { return &static_cast<const std::vector<Pair>*>(pairs)->data()->first; }

void pairs_release(void* pairs) { delete static_cast<std::vector<Pair>*>(pairs); }
}
