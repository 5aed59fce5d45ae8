// Copyright the Cloudroid authors. SPDX-License-Identifier: Apache-2.0
//
// Converts a recording of MRPT (laser and odometry) to a bag: /scan, /odom and, where a reference is known,
// /ground_truth.

#include <geometry_msgs/PoseStamped.h>
#include <mrpt/core/Clock.h>
#include <mrpt/maps/CSimpleMap.h>
#include <mrpt/obs/CActionCollection.h>
#include <mrpt/obs/CActionRobotMovement2D.h>
#include <mrpt/obs/CObservation2DRangeScan.h>
#include <mrpt/obs/CRawlog.h>
#include <mrpt/obs/CSensoryFrame.h>
#include <mrpt/poses/CPose2D.h>
#include <mrpt/poses/CPose3DPDF.h>
#include <nav_msgs/Odometry.h>
#include <rosbag/bag.h>
#include <sensor_msgs/LaserScan.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <fstream>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace {

namespace fs = std::filesystem;
using mrpt::obs::CObservation2DRangeScan;
using mrpt::poses::CPose2D;

// A real drive, 76 metres through a floor of a faculty of the University of Malaga.
const char* const kDefault = "/usr/share/mrpt/datasets/2006-01ENE-21-SENA_Telecom Faculty_one_loop_only.rawlog";
// The recordings say how far the robot moved from one scan to the next. The sum is what the odometry says at a scan,
// and comes a little before it.
const ros::Duration kBefore(0.001);

struct Step {
  ros::Time time;
  CPose2D odometry;
  CObservation2DRangeScan::Ptr scan;
};

ros::Time timeOf(const CObservation2DRangeScan& scan) {
  if (scan.timestamp == INVALID_TIMESTAMP) throw std::runtime_error("a scan has no time");
  // Whole microseconds: a double of this size has no more.
  const auto micros = std::llround(mrpt::Clock::toDouble(scan.timestamp) * 1e6);
  return ros::Time(micros / 1000000, micros % 1000000 * 1000);
}

std::vector<Step> load(const std::string& path) {
  mrpt::obs::CRawlog log;
  if (!fs::exists(path) || !log.loadFromRawLogFile(path)) throw std::runtime_error("cannot read " + path);
  std::vector<Step> steps;
  CPose2D odometry;
  for (size_t i = 0; i < log.size(); ++i) {
    const auto entry = log.getAsGeneric(i);
    if (const auto actions = std::dynamic_pointer_cast<mrpt::obs::CActionCollection>(entry)) {
      const auto moved = actions->getActionByClass<mrpt::obs::CActionRobotMovement2D>();
      if (moved) odometry = odometry + moved->rawOdometryIncrementReading;
    } else if (const auto frame = std::dynamic_pointer_cast<mrpt::obs::CSensoryFrame>(entry)) {
      const auto scan = frame->getObservationByClass<CObservation2DRangeScan>();
      if (scan) steps.push_back({timeOf(*scan), odometry, scan});
    }
  }
  if (steps.empty()) throw std::runtime_error("no laser scans of actions and observations in " + path);
  return steps;
}

// Poses of the robot by the times of scans.
using Reference = std::map<ros::Time, CPose2D>;

// "time x y heading" a line, as MRPT's simulator writes it.
Reference fromText(const std::string& path, const std::vector<Step>& steps) {
  std::map<double, CPose2D> lines;
  std::ifstream in(path);
  double time, x, y, phi;
  while (in >> time >> x >> y >> phi) lines.emplace(time, CPose2D(x, y, phi));
  Reference out;
  for (const auto& step : steps) {
    const auto found = lines.lower_bound(step.time.toSec() - 1e-5);
    if (found != lines.end() && found->first < step.time.toSec() + 1e-5) out.emplace(step.time, found->second);
  }
  return out;
}

// A map of MRPT's SLAM: scans of the recording, with the poses that were found for them afterwards.
Reference fromSimpleMap(const std::string& path, const std::vector<Step>& steps) {
  Reference out;
  mrpt::maps::CSimpleMap map;
  if (!map.loadFromFile(path)) return out;
  for (size_t i = 0; i < map.size(); ++i) {
    mrpt::poses::CPose3DPDF::Ptr pose;
    mrpt::obs::CSensoryFrame::Ptr frame;
    map.get(i, pose, frame);
    const auto scan = frame->getObservationByClass<CObservation2DRangeScan>();
    if (scan && scan->timestamp != INVALID_TIMESTAMP) out.emplace(timeOf(*scan), CPose2D(pose->getMeanVal()));
  }
  Reference ours;
  for (const auto& step : steps) {
    if (const auto found = out.find(step.time); found != out.end()) ours.insert(*found);
  }
  return ours;
}

bool isSimpleMap(const std::string& path) { return path.find(".simplemap") != std::string::npos; }

// RECORDING.GT.txt, or the map beside the recording that holds most of its scans. The path is empty if there is none.
std::pair<std::string, Reference> findReference(const std::string& recording, const std::vector<Step>& steps) {
  const std::string text = recording + ".GT.txt";
  if (fs::exists(text)) return {text, fromText(text, steps)};
  std::vector<std::string> paths;
  for (const auto& entry : fs::directory_iterator(fs::absolute(recording).parent_path())) {
    if (isSimpleMap(entry.path().filename())) paths.push_back(entry.path());
  }
  std::sort(paths.begin(), paths.end());
  std::pair<std::string, Reference> best;
  for (const auto& path : paths) {
    Reference reference = fromSimpleMap(path, steps);
    if (reference.size() > best.second.size()) best = {path, std::move(reference)};
  }
  return best;
}

geometry_msgs::Pose toPose(const CPose2D& pose) {
  geometry_msgs::Pose msg;
  msg.position.x = pose.x();
  msg.position.y = pose.y();
  msg.orientation.z = std::sin(pose.phi() / 2);
  msg.orientation.w = std::cos(pose.phi() / 2);
  return msg;
}

nav_msgs::Odometry toOdometry(const Step& step) {
  nav_msgs::Odometry msg;
  msg.header.stamp = step.time - kBefore;
  msg.header.frame_id = "odom";
  msg.child_frame_id = "base_link";
  msg.pose.pose = toPose(step.odometry);
  return msg;
}

sensor_msgs::LaserScan toScan(const Step& step) {
  const CObservation2DRangeScan& scan = *step.scan;
  const size_t n = scan.getScanSize();
  sensor_msgs::LaserScan msg;
  msg.header.stamp = step.time;
  msg.header.frame_id = "laser";
  const float direction = scan.rightToLeft ? 1.0F : -1.0F;
  msg.angle_min = -direction * scan.aperture / 2;
  msg.angle_max = direction * scan.aperture / 2;
  msg.angle_increment = n > 1 ? direction * scan.aperture / static_cast<float>(n - 1) : 0.0F;
  msg.range_min = 0.05F;
  msg.range_max = scan.maxRange;
  msg.ranges.resize(n);
  for (size_t i = 0; i < n; ++i) {
    // Beyond the maximum means no echo.
    msg.ranges[i] = scan.getScanRangeValidity(i) ? scan.getScanRange(i) : scan.maxRange + 1;
  }
  return msg;
}

void convert(const std::string& out, const std::string& in, const std::string& given) {
  const std::vector<Step> steps = load(in);
  std::pair<std::string, Reference> reference;
  if (given.empty()) {
    reference = findReference(in, steps);
  } else {
    reference = {given, isSimpleMap(given) ? fromSimpleMap(given, steps) : fromText(given, steps)};
    if (reference.second.empty()) throw std::runtime_error("no pose of a scan of the recording in " + given);
  }

  rosbag::Bag bag(out, rosbag::bagmode::Write);
  for (const Step& step : steps) {
    bag.write("/odom", step.time - kBefore, toOdometry(step));
    bag.write("/scan", step.time, toScan(step));
    if (const auto known = reference.second.find(step.time); known != reference.second.end()) {
      geometry_msgs::PoseStamped msg;
      msg.header.stamp = step.time;
      msg.header.frame_id = "map";
      msg.pose = toPose(known->second);
      bag.write("/ground_truth", step.time, msg);
    }
  }
  bag.close();

  double length = 0;
  for (size_t i = 1; i < steps.size(); ++i) length += (steps[i].odometry - steps[i - 1].odometry).norm();
  const auto& laser = steps.front().scan->sensorPose;
  std::printf("%zu scans, %.1f s, %.1f m by odometry; the laser is at x %.2f y %.2f yaw %.2f of the robot\n",
              steps.size(), (steps.back().time - steps.front().time).toSec(), length, laser.x(), laser.y(),
              laser.yaw());
  if (reference.second.empty()) {
    std::printf("no reference: no /ground_truth\n");
  } else {
    std::printf("/ground_truth of %zu scans: %s\n", reference.second.size(), reference.first.c_str());
  }
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 2 || argc > 4) {
    std::fprintf(stderr,
                 "usage: rawlog_to_bag OUT.bag [IN.rawlog [REFERENCE]]\n"
                 "IN.rawlog: by default %s\n"
                 "REFERENCE: a .simplemap(.gz) or lines of \"time x y heading\";\n"
                 "           by default IN.rawlog.GT.txt or the map beside IN.rawlog that holds most of its scans\n",
                 kDefault);
    return 2;
  }
  try {
    convert(argv[1], argc > 2 ? argv[2] : kDefault, argc > 3 ? argv[3] : "");
  } catch (const std::exception& error) {
    std::fprintf(stderr, "rawlog_to_bag: %s\n", error.what());
    return 1;
  }
  return 0;
}
