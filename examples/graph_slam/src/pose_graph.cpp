// Copyright the Cloudroid authors. SPDX-License-Identifier: Apache-2.0
#include "pose_graph.h"

#include <Eigen/SparseCholesky>
#include <cmath>

namespace graph_slam {

namespace {

// Errors beyond this many standard deviations count linearly.
constexpr double kHuber = 3.0;
constexpr double kConverged = 1e-5;  // metres and radians

Eigen::Matrix2d rotation(double angle) {
  const double c = std::cos(angle), s = std::sin(angle);
  return (Eigen::Matrix2d() << c, -s, s, c).finished();
}

}  // namespace

double normalized(double angle) { return std::atan2(std::sin(angle), std::cos(angle)); }

Pose compose(const Pose& a, const Pose& b) {
  Pose out;
  out.head<2>() = a.head<2>() + rotation(a[2]) * b.head<2>();
  out[2] = normalized(a[2] + b[2]);
  return out;
}

Pose between(const Pose& a, const Pose& b) {
  Pose out;
  out.head<2>() = rotation(-a[2]) * (b.head<2>() - a.head<2>());
  out[2] = normalized(b[2] - a[2]);
  return out;
}

size_t PoseGraph::add(const Pose& pose) {
  poses_.push_back(pose);
  return poses_.size() - 1;
}

int PoseGraph::optimize(int iterations) {
  if (poses_.size() < 2 || edges_.empty()) return 0;
  // The first pose stays: pose i has the unknowns from 3 (i - 1) on.
  const auto unknowns = static_cast<Eigen::Index>(3 * (poses_.size() - 1));
  const auto first = [](size_t pose) { return 3 * (static_cast<Eigen::Index>(pose) - 1); };
  int done = 0;
  while (done < iterations) {
    std::vector<Eigen::Triplet<double>> entries;
    entries.reserve(edges_.size() * 36);
    Eigen::VectorXd gradient = Eigen::VectorXd::Zero(unknowns);
    for (const Edge& edge : edges_) {
      const Pose& a = poses_[edge.from];
      const Pose& b = poses_[edge.to];
      const Pose now = between(a, b);
      Eigen::Vector3d error = now - edge.measured;
      error[2] = normalized(error[2]);

      // The derivatives of `now` by a and b.
      Eigen::Matrix3d by_a = Eigen::Matrix3d::Zero(), by_b = Eigen::Matrix3d::Zero();
      by_b.topLeftCorner<2, 2>() = rotation(-a[2]);
      by_b(2, 2) = 1;
      by_a.topLeftCorner<2, 2>() = -rotation(-a[2]);
      by_a(0, 2) = now[1];
      by_a(1, 2) = -now[0];
      by_a(2, 2) = -1;

      const double deviation = std::sqrt(error.cwiseProduct(edge.weight).dot(error));
      const Eigen::Vector3d weight = edge.weight * (deviation > kHuber ? kHuber / deviation : 1.0);
      const size_t ends[] = {edge.from, edge.to};
      const Eigen::Matrix3d jacobians[] = {by_a, by_b};
      for (int i = 0; i < 2; ++i) {
        if (ends[i] == 0) continue;
        const Eigen::Matrix3d weighted = jacobians[i].transpose() * weight.asDiagonal();
        gradient.segment<3>(first(ends[i])) += weighted * error;
        for (int j = 0; j < 2; ++j) {
          if (ends[j] == 0) continue;
          const Eigen::Matrix3d block = weighted * jacobians[j];
          for (int row = 0; row < 3; ++row) {
            for (int column = 0; column < 3; ++column) {
              entries.emplace_back(first(ends[i]) + row, first(ends[j]) + column, block(row, column));
            }
          }
        }
      }
    }
    Eigen::SparseMatrix<double> hessian(unknowns, unknowns);
    hessian.setFromTriplets(entries.begin(), entries.end());
    const Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>> solver(hessian);
    if (solver.info() != Eigen::Success) return done;
    const Eigen::VectorXd step = solver.solve(-gradient);
    if (!step.allFinite()) return done;
    for (size_t i = 1; i < poses_.size(); ++i) {
      poses_[i] += step.segment<3>(first(i));
      poses_[i][2] = normalized(poses_[i][2]);
    }
    ++done;
    if (step.lpNorm<Eigen::Infinity>() < kConverged) break;
  }
  return done;
}

}  // namespace graph_slam
