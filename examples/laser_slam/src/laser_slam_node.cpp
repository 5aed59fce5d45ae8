// Copyright the Cloudroid authors. SPDX-License-Identifier: Apache-2.0
//
// Matches each laser scan with the map made so far, inserts it, and draws the map.

#include <geometry_msgs/PoseStamped.h>
#include <laser_slam/Timing.h>
#include <mrpt/maps/COccupancyGridMap2D.h>
#include <mrpt/maps/CSimplePointsMap.h>
#include <mrpt/obs/CObservation2DRangeScan.h>
#include <mrpt/poses/CPose3D.h>
#include <nav_msgs/OccupancyGrid.h>
#include <nav_msgs/Odometry.h>
#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <sensor_msgs/LaserScan.h>

#include <cmath>
#include <iterator>
#include <limits>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "scan_matcher.h"

namespace {

using mrpt::maps::COccupancyGridMap2D;
using mrpt::maps::CSimplePointsMap;
using mrpt::obs::CObservation2DRangeScan;
using mrpt::poses::CPose2D;
using ros::WallTime;

double yawOf(const geometry_msgs::Quaternion& q) {
  return std::atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z));
}

geometry_msgs::Pose toPose(const CPose2D& pose) {
  geometry_msgs::Pose msg;
  msg.position.x = pose.x();
  msg.position.y = pose.y();
  msg.orientation.z = std::sin(pose.phi() / 2);
  msg.orientation.w = std::cos(pose.phi() / 2);
  return msg;
}

// The occupancy, 0 to 100 or -1, for each value that a cell of MRPT's grid can have.
class Occupancy {
 public:
  using Cell = COccupancyGridMap2D::cellType;

  Occupancy() {
    for (int value = kLowest; value <= kHighest; ++value) {
      const double occupied = 1.0 - COccupancyGridMap2D::l2p(static_cast<Cell>(value));
      table_.push_back(value == 0 ? -1 : static_cast<int8_t>(std::lround(100 * occupied)));
    }
  }

  int8_t operator()(Cell value) const { return table_[value - kLowest]; }

 private:
  static constexpr int kLowest = std::numeric_limits<Cell>::min();
  static constexpr int kHighest = std::numeric_limits<Cell>::max();
  std::vector<int8_t> table_;
};

class LaserSlam {
 public:
  LaserSlam()
      : private_("~"),
        frame_(private_.param<std::string>("map_frame", "map")),
        laser_(private_.param("laser_x", 0.0), private_.param("laser_y", 0.0), private_.param("laser_yaw", 0.0)),
        max_range_(private_.param("max_range", 20.0)),
        point_spacing_(private_.param("point_spacing", 0.05)),
        min_score_(private_.param("min_score", 0.3)),
        render_every_(std::max(1, private_.param("render_every", 1))),
        odom_wait_(private_.param("odom_wait", 0.25)),
        odom_slack_(private_.param("odom_slack", 0.05)),
        matcher_(window(), std::max(1, private_.param("refined", 5))),
        grid_(-10.0F, 10.0F, -10.0F, 10.0F, static_cast<float>(private_.param("resolution", 0.05))) {
    grid_.insertionOptions.maxDistanceInsertion = static_cast<float>(max_range_);
    grid_.insertionOptions.considerInvalidRangesAsFreeSpace = false;

    timing_pub_ = private_.advertise<laser_slam::Timing>("timing", 10);
    pose_pub_ = private_.advertise<geometry_msgs::PoseStamped>("pose", 10);
    map_pub_ = node_.advertise<nav_msgs::OccupancyGrid>("map", 1, true);
    odom_sub_ = node_.subscribe("odom", 50, &LaserSlam::odomReceived, this);
    scan_sub_ = node_.subscribe("scan", 1, &LaserSlam::scanReceived, this);
  }

  // The callbacks only take notice; a scan is worked on when the odometry that belongs to it is there.
  void spin() {
    ros::CallbackQueue* queue = ros::getGlobalCallbackQueue();
    while (ros::ok()) {
      queue->callAvailable(ros::WallDuration(scan_ ? 0.001 : 0.1));
      if (scan_ && odometryIsThere()) {
        process();
        scan_.reset();
      }
    }
  }

 private:
  laser_slam::Window window() const {
    laser_slam::Window window;
    window.distance = private_.param("search_distance", window.distance);
    window.distance_step = private_.param("search_distance_step", window.distance_step);
    window.angle = private_.param("search_angle", window.angle);
    window.angle_step = private_.param("search_angle_step", window.angle_step);
    return window;
  }

  static constexpr size_t kOdoms = 200;

  void odomReceived(const nav_msgs::Odometry::ConstPtr& msg) {
    const auto& p = msg->pose.pose;
    const CPose2D odom(p.position.x, p.position.y, yawOf(p.orientation));
    if (!std::isfinite(odom.x() + odom.y() + odom.phi())) return;
    // A recording that is played anew begins with earlier stamps.
    if (!odoms_.empty() && msg->header.stamp + ros::Duration(10.0) < odoms_.rbegin()->first) odoms_.clear();
    odoms_[msg->header.stamp] = odom;
    if (odoms_.size() > kOdoms) odoms_.erase(odoms_.begin());
  }

  void scanReceived(const sensor_msgs::LaserScan::ConstPtr& msg) {
    scan_ = msg;
    scan_received_ = WallTime::now();
  }

  // Scan and odometry come on connections of their own, in any order: what belongs together is told by the stamps.
  bool odometryIsThere() const {
    const bool there = !odoms_.empty() && odoms_.rbegin()->first + odom_slack_ >= scan_->header.stamp;
    return there || odom_sub_.getNumPublishers() == 0 || (WallTime::now() - scan_received_).toSec() >= odom_wait_;
  }

  // What was measured nearest to the scan.
  std::optional<CPose2D> odometry() const {
    if (odoms_.empty()) return std::nullopt;
    const ros::Time at = scan_->header.stamp;
    auto nearest = odoms_.lower_bound(at);
    if (nearest == odoms_.end()) return std::prev(nearest)->second;
    if (nearest != odoms_.begin() && at - std::prev(nearest)->first < nearest->first - at) --nearest;
    return nearest->second;
  }

  void process() {
    const CObservation2DRangeScan scan = toObservation(*scan_);
    CSimplePointsMap points;
    points.insertionOptions.minDistBetweenLaserPoints = 0.02F;
    if (scan.getScanSize() > 0) points.loadFromRangeScan(scan);
    const WallTime acquired = WallTime::now();

    CPose2D guess = pose_;
    const std::optional<CPose2D> odom = odometry();
    if (odom && odom_before_) guess = pose_ + (*odom - *odom_before_);
    if (odom) odom_before_ = odom;
    pose_ = guess;
    if (!points.empty()) {
      bool fits = true;
      if (!map_.empty()) {
        const laser_slam::Match match = matcher_.match(map_, points, guess);
        fits = match.score >= min_score_;
        if (fits) {
          pose_ = match.pose;
        } else {
          ROS_WARN_THROTTLE(1.0, "the scan does not fit the map (%.2f): odometry alone", match.score);
        }
      }
      insert(scan, points);
    }
    const WallTime computed = WallTime::now();

    nav_msgs::OccupancyGrid::Ptr drawn;
    if (scans_++ % render_every_ == 0) drawn = render();
    const WallTime rendered = WallTime::now();

    laser_slam::Timing timing;
    timing.header.stamp = scan_->header.stamp;
    timing.header.frame_id = frame_;
    timing.acquisition = (acquired - scan_received_).toSec();
    timing.computation = (computed - acquired).toSec();
    timing.rendering = (rendered - computed).toSec();
    timing_pub_.publish(timing);

    geometry_msgs::PoseStamped pose;
    pose.header = timing.header;
    pose.pose = toPose(pose_);
    pose_pub_.publish(pose);
    if (drawn) map_pub_.publish(drawn);
  }

  // Without any ray if the message makes no sense.
  CObservation2DRangeScan toObservation(const sensor_msgs::LaserScan& msg) const {
    CObservation2DRangeScan scan;
    const size_t n = msg.ranges.size();
    const double span = n > 1 ? msg.angle_increment * (n - 1.0) : 0.0;
    if (!std::isfinite(msg.angle_min) || !(std::abs(span) > 0 && std::abs(span) < 6.3)) return scan;
    const float farthest = std::min(static_cast<float>(max_range_), msg.range_max);
    scan.aperture = static_cast<float>(std::abs(span));
    scan.rightToLeft = span > 0;
    scan.maxRange = farthest;
    scan.sensorPose = mrpt::poses::CPose3D(laser_.x(), laser_.y(), 0, laser_.phi() + msg.angle_min + span / 2, 0, 0);
    scan.resizeScan(n);
    for (size_t i = 0; i < n; ++i) {
      const float range = msg.ranges[i];
      const bool valid = range >= msg.range_min && range < farthest;  // false for NaN
      scan.setScanRange(i, valid ? range : 0.0F);
      scan.setScanRangeValidity(i, valid);
    }
    return scan;
  }

  void insert(const CObservation2DRangeScan& scan, const CSimplePointsMap& points) {
    std::vector<std::pair<double, double>> fresh;
    for (size_t i = 0; i < points.size(); ++i) {
      float x, y;
      points.getPoint(i, x, y);
      double gx, gy;
      pose_.composePoint(x, y, gx, gy);
      if (map_.empty() || map_.kdTreeClosestPoint2DsqrError(gx, gy) > point_spacing_ * point_spacing_) {
        fresh.emplace_back(gx, gy);
      }
    }
    for (const auto& [x, y] : fresh) map_.insertPoint(x, y);
    grid_.insertObservation(scan, mrpt::poses::CPose3D(pose_));
  }

  nav_msgs::OccupancyGrid::Ptr render() const {
    auto msg = boost::make_shared<nav_msgs::OccupancyGrid>();
    msg->header.stamp = scan_->header.stamp;
    msg->header.frame_id = frame_;
    msg->info.map_load_time = scan_->header.stamp;
    msg->info.resolution = grid_.getResolution();
    msg->info.width = grid_.getSizeX();
    msg->info.height = grid_.getSizeY();
    msg->info.origin.position.x = grid_.getXMin();
    msg->info.origin.position.y = grid_.getYMin();
    msg->info.origin.orientation.w = 1;
    msg->data.reserve(static_cast<size_t>(msg->info.width) * msg->info.height);
    for (const auto cell : grid_.getRawMap()) msg->data.push_back(occupancy_(cell));
    return msg;
  }

  ros::NodeHandle node_;
  ros::NodeHandle private_;
  const std::string frame_;
  const CPose2D laser_;
  const double max_range_;
  const double point_spacing_;
  const double min_score_;
  const int render_every_;
  const double odom_wait_;
  const ros::Duration odom_slack_;
  const laser_slam::ScanMatcher matcher_;
  const Occupancy occupancy_;

  CSimplePointsMap map_;
  COccupancyGridMap2D grid_;
  CPose2D pose_;
  long scans_ = 0;

  std::map<ros::Time, CPose2D> odoms_;  // the latest
  std::optional<CPose2D> odom_before_;  // at the scan before
  sensor_msgs::LaserScan::ConstPtr scan_;  // to be worked on
  WallTime scan_received_;

  ros::Publisher timing_pub_;
  ros::Publisher pose_pub_;
  ros::Publisher map_pub_;
  ros::Subscriber odom_sub_;
  ros::Subscriber scan_sub_;
};

}  // namespace

int main(int argc, char** argv) {
  ros::init(argc, argv, "laser_slam");
  LaserSlam slam;
  slam.spin();
  return 0;
}
