// Copyright the Cloudroid authors. SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <vector>

namespace graph_slam {

using Pose = Eigen::Vector3d;  // x, y, heading

Pose compose(const Pose& a, const Pose& b);  // b, given in a's frame, in the frame in which a is given
Pose between(const Pose& a, const Pose& b);  // b in a's frame
double normalized(double angle);             // to (-pi, pi]

// Poses, and what was measured between them.
class PoseGraph {
 public:
  struct Edge {
    size_t from;
    size_t to;
    Pose measured;            // `to` in the frame of `from`
    Eigen::Vector3d weight;   // inverse variances along `from`'s x and y, and of the heading
  };

  size_t add(const Pose& pose);
  void move(size_t node, const Pose& to) { poses_[node] = to; }
  void add(const Edge& edge) { edges_.push_back(edge); }

  const std::vector<Pose>& poses() const { return poses_; }
  size_t edges() const { return edges_.size(); }

  // Moves all poses but the first to where the edges contradict each other least (Gauss-Newton; edges that contradict
  // the others grossly count less). Returns the number of iterations.
  int optimize(int iterations);

 private:
  std::vector<Pose> poses_;
  std::vector<Edge> edges_;
};

}  // namespace graph_slam
