// Copyright the Cloudroid authors. SPDX-License-Identifier: Apache-2.0
#include "scan_matcher.h"

#include <mrpt/maps/metric_map_types.h>
#include <mrpt/math/TPose2D.h>
#include <mrpt/tfest/TMatchingPair.h>
#include <mrpt/tfest/se2.h>

#include <algorithm>
#include <cmath>
#include <vector>

namespace laser_slam {

using mrpt::maps::CSimplePointsMap;
using mrpt::poses::CPose2D;

namespace {

// Points farther apart than this (metres) are not paired: one round of iterations for each.
constexpr double kRounds[] = {0.5, 0.25, 0.12};
constexpr int kIterations = 25;
constexpr double kStill = 1e-4;  // metres and radians: below this a round has converged
constexpr size_t kFewest = 10;   // pairs

// A point this far (metres) from the map adds nothing to the score: while searching, and in the end.
constexpr double kSearchDistance = 0.4;
constexpr double kScoreDistance = 0.2;
// The search looks at about this many points of the scan.
constexpr size_t kSearchPoints = 90;
// What the score loses at the window's edge: of two poses that fit alike, the one nearer to the guess is likelier.
constexpr double kFarther = 0.05;

// Only every so many-th point counts.
double score(const CSimplePointsMap& map, const CSimplePointsMap& scan, const CPose2D& pose, double distance,
             size_t every) {
  double sum = 0;
  size_t points = 0;
  for (size_t i = 0; i < scan.size(); i += every, ++points) {
    float x, y;
    scan.getPoint(i, x, y);
    double gx, gy;
    pose.composePoint(x, y, gx, gy);
    const double d2 = map.kdTreeClosestPoint2DsqrError(gx, gy);
    sum += std::max(0.0, 1.0 - d2 / (distance * distance));
  }
  return points == 0 ? 0.0 : sum / points;
}

Match refine(const CSimplePointsMap& map, const CSimplePointsMap& scan, CPose2D pose) {
  mrpt::maps::TMatchingParams params;
  mrpt::maps::TMatchingExtraResults extra;
  mrpt::tfest::TMatchingPairList pairs;
  params.maxAngularDistForCorrespondence = 0.0F;
  params.onlyKeepTheClosest = false;
  for (const double distance : kRounds) {
    params.maxDistForCorrespondence = distance;
    for (int i = 0; i < kIterations; ++i) {
      map.determineMatching2D(&scan, pose, pairs, params, extra);
      mrpt::math::TPose2D next;
      if (pairs.size() < kFewest || !mrpt::tfest::se2_l2(pairs, next)) break;
      const CPose2D moved = CPose2D(next) - pose;
      pose = CPose2D(next);
      if (moved.norm() < kStill && std::abs(moved.phi()) < kStill) break;
    }
  }
  return {pose, score(map, scan, pose, kScoreDistance, 1)};
}

}  // namespace

Match ScanMatcher::match(const CSimplePointsMap& map, const CSimplePointsMap& scan, const CPose2D& guess) const {
  const int shifts = static_cast<int>(std::lround(window_.distance / window_.distance_step));
  const int turns = static_cast<int>(std::lround(window_.angle / window_.angle_step));
  const size_t every = std::max<size_t>(1, scan.size() / kSearchPoints);
  std::vector<Match> tried;
  for (int x = -shifts; x <= shifts; ++x) {
    for (int y = -shifts; y <= shifts; ++y) {
      for (int turn = -turns; turn <= turns; ++turn) {
        const CPose2D pose(guess.x() + x * window_.distance_step, guess.y() + y * window_.distance_step,
                           guess.phi() + turn * window_.angle_step);
        const double edge = std::hypot(x, y) / std::max(1, shifts) + std::abs(turn) / std::max(1.0, 1.0 * turns);
        tried.push_back({pose, score(map, scan, pose, kSearchDistance, every) - kFarther * edge});
      }
    }
  }
  std::stable_sort(tried.begin(), tried.end(), [](const Match& a, const Match& b) { return a.score > b.score; });
  // The guess itself is always refined.
  Match best = refine(map, scan, guess);
  for (size_t i = 0; i < tried.size() && i + 1 < static_cast<size_t>(refined_); ++i) {
    const Match other = refine(map, scan, tried[i].pose);
    if (other.score > best.score) best = other;
  }
  return best;
}

}  // namespace laser_slam
