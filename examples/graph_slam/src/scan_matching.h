// Copyright the Cloudroid authors. SPDX-License-Identifier: Apache-2.0
#pragma once

#include <mrpt/maps/CSimplePointsMap.h>

#include "pose_graph.h"

namespace graph_slam {

struct Match {
  Pose pose;         // of the later scan, in the frame of the earlier
  double share = 0;  // of the later scan's points that lie on the earlier
  double error = 0;  // their mean squared distance
};

// Iterative closest point, from coarse to fine, from several headings around the guess; the best outcome wins.
// `reach`: how far apart (metres), at first, paired points may be, and the headings reach as many quarter radians.
Match matchScans(const mrpt::maps::CSimplePointsMap& earlier, const mrpt::maps::CSimplePointsMap& later,
                 const Pose& guess, double reach, int headings);

}  // namespace graph_slam
