// Copyright the Cloudroid authors. SPDX-License-Identifier: Apache-2.0
#include "scan_matching.h"

#include <mrpt/maps/metric_map_types.h>
#include <mrpt/math/TPose2D.h>
#include <mrpt/poses/CPose2D.h>
#include <mrpt/tfest/TMatchingPair.h>
#include <mrpt/tfest/se2.h>

#include <algorithm>
#include <cmath>

namespace graph_slam {

using mrpt::maps::CSimplePointsMap;
using mrpt::poses::CPose2D;

namespace {

constexpr double kFinest = 0.15;  // metres: the last round pairs points that are no farther apart
constexpr int kIterations = 30;   // a round
constexpr double kStill = 1e-4;
constexpr size_t kFewest = 10;    // pairs

Match refine(const CSimplePointsMap& earlier, const CSimplePointsMap& later, const Pose& guess, double reach) {
  mrpt::maps::TMatchingParams params;
  mrpt::maps::TMatchingExtraResults extra;
  mrpt::tfest::TMatchingPairList pairs;
  params.maxAngularDistForCorrespondence = 0.0F;
  params.onlyKeepTheClosest = false;
  CPose2D pose(guess[0], guess[1], guess[2]);
  for (double distance = reach;; distance = std::max(kFinest, distance / 2)) {
    params.maxDistForCorrespondence = static_cast<float>(distance);
    for (int i = 0; i < kIterations; ++i) {
      earlier.determineMatching2D(&later, pose, pairs, params, extra);
      mrpt::math::TPose2D next;
      if (pairs.size() < kFewest || !mrpt::tfest::se2_l2(pairs, next)) return {guess, 0, 0};
      const CPose2D moved = CPose2D(next) - pose;
      pose = CPose2D(next);
      if (moved.norm() < kStill && std::abs(moved.phi()) < kStill) break;
    }
    if (distance <= kFinest) break;
  }
  earlier.determineMatching2D(&later, pose, pairs, params, extra);
  Match match;
  match.pose = Pose(pose.x(), pose.y(), pose.phi());
  match.share = extra.correspondencesRatio;
  for (const auto& pair : pairs) match.error += pair.errorSquareAfterTransformation / static_cast<double>(pairs.size());
  return match;
}

}  // namespace

Match matchScans(const CSimplePointsMap& earlier, const CSimplePointsMap& later, const Pose& guess, double reach,
                 int headings) {
  Match best = refine(earlier, later, guess, reach);
  const int sides = headings / 2;
  for (int i = -sides; i <= sides; ++i) {
    if (i == 0) continue;
    const Match other = refine(earlier, later, guess + Pose(0, 0, reach / 4 * i / sides), reach);
    if (other.share > best.share) best = other;
  }
  return best;
}

}  // namespace graph_slam
