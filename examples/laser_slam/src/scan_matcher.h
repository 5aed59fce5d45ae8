// Copyright the Cloudroid authors. SPDX-License-Identifier: Apache-2.0
#pragma once

#include <mrpt/maps/CSimplePointsMap.h>
#include <mrpt/poses/CPose2D.h>

namespace laser_slam {

// The outcome of matching a scan with a map.
struct Match {
  mrpt::poses::CPose2D pose;  // of the robot, in the map
  double score = 0;           // 0 (nothing fits) to 1 (every point lies on the map)
};

// Where, around a first guess, the robot is looked for: this far (metres, radians), in steps of this size.
struct Window {
  double distance = 0.6;
  double distance_step = 0.2;
  double angle = 0.2;
  double angle_step = 0.01;
};

// Tries the poses of a window, and refines the best of them by iterative closest point, from coarse to fine.
class ScanMatcher {
 public:
  ScanMatcher(const Window& window, int refined) : window_(window), refined_(refined) {}

  // `scan` is in the robot's frame. Neither map is empty.
  Match match(const mrpt::maps::CSimplePointsMap& map, const mrpt::maps::CSimplePointsMap& scan,
              const mrpt::poses::CPose2D& guess) const;

 private:
  Window window_;
  int refined_;
};

}  // namespace laser_slam
