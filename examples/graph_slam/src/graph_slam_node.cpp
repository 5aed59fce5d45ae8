// Copyright the Cloudroid authors. SPDX-License-Identifier: Apache-2.0
//
// Makes a graph of laser scans: matches each with earlier ones taken nearby, optimises the graph, and draws the map of
// all scans anew. The more scans there are, the longer it takes.

#include <geometry_msgs/PoseStamped.h>
#include <graph_slam/Timing.h>
#include <mrpt/maps/COccupancyGridMap2D.h>
#include <mrpt/maps/CSimplePointsMap.h>
#include <mrpt/obs/CObservation2DRangeScan.h>
#include <mrpt/poses/CPose3D.h>
#include <nav_msgs/OccupancyGrid.h>
#include <nav_msgs/Odometry.h>
#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <sensor_msgs/LaserScan.h>

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "pose_graph.h"
#include "scan_matching.h"

namespace {

using mrpt::maps::COccupancyGridMap2D;
using mrpt::maps::CSimplePointsMap;
using mrpt::obs::CObservation2DRangeScan;
using graph_slam::Pose;
using ros::WallTime;

double yawOf(const geometry_msgs::Quaternion& q) {
  return std::atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z));
}

geometry_msgs::Pose toMessage(const Pose& pose) {
  geometry_msgs::Pose msg;
  msg.position.x = pose[0];
  msg.position.y = pose[1];
  msg.orientation.z = std::sin(pose[2] / 2);
  msg.orientation.w = std::cos(pose[2] / 2);
  return msg;
}

// How sure an edge is: inverse variances, of standard deviations in metres and radians.
Eigen::Vector3d weight(double distance, double angle) {
  return Eigen::Vector3d(1 / (distance * distance), 1 / (distance * distance), 1 / (angle * angle));
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

class GraphSlam {
 public:
  GraphSlam()
      : private_("~"),
        frame_(private_.param<std::string>("map_frame", "map")),
        laser_(private_.param("laser_x", 0.0), private_.param("laser_y", 0.0), private_.param("laser_yaw", 0.0)),
        max_range_(private_.param("max_range", 20.0)),
        neighbourhood_(private_.param("neighbourhood", 20.0)),
        headings_(private_.param("headings", 3)),
        min_share_(private_.param("min_share", 0.6)),
        iterations_(private_.param("iterations", 10)),
        render_every_(std::max(1, private_.param("render_every", 1))),
        odom_wait_(private_.param("odom_wait", 0.25)),
        odom_slack_(private_.param("odom_slack", 0.05)),
        grid_(-10.0F, 10.0F, -10.0F, 10.0F, static_cast<float>(private_.param("resolution", 0.05))) {
    grid_.insertionOptions.maxDistanceInsertion = static_cast<float>(max_range_);
    grid_.insertionOptions.considerInvalidRangesAsFreeSpace = false;

    timing_pub_ = private_.advertise<graph_slam::Timing>("timing", 10);
    pose_pub_ = private_.advertise<geometry_msgs::PoseStamped>("pose", 10);
    map_pub_ = node_.advertise<nav_msgs::OccupancyGrid>("map", 1, true);
    odom_sub_ = node_.subscribe("odom", 50, &GraphSlam::odomReceived, this);
    scan_sub_ = node_.subscribe("scan", 1, &GraphSlam::scanReceived, this);
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
  // A scan, and its points in the robot's frame; its pose is in the graph.
  struct Node {
    CObservation2DRangeScan scan;
    CSimplePointsMap points;
  };

  static constexpr size_t kOdoms = 200;

  void odomReceived(const nav_msgs::Odometry::ConstPtr& msg) {
    const auto& p = msg->pose.pose;
    const Pose odom(p.position.x, p.position.y, yawOf(p.orientation));
    if (!odom.allFinite()) return;
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
  std::optional<Pose> odometry() const {
    if (odoms_.empty()) return std::nullopt;
    const ros::Time at = scan_->header.stamp;
    auto nearest = odoms_.lower_bound(at);
    if (nearest == odoms_.end()) return std::prev(nearest)->second;
    if (nearest != odoms_.begin() && at - std::prev(nearest)->first < nearest->first - at) --nearest;
    return nearest->second;
  }

  void process() {
    auto node = std::make_unique<Node>();
    node->scan = toObservation(*scan_);
    node->points.insertionOptions.minDistBetweenLaserPoints = 0.02F;
    if (node->scan.getScanSize() > 0) node->points.loadFromRangeScan(node->scan);
    const WallTime acquired = WallTime::now();

    Pose moved = Pose::Zero();
    const std::optional<Pose> odom = odometry();
    if (odom && odom_before_) moved = graph_slam::between(*odom_before_, *odom);
    if (odom) odom_before_ = odom;
    nodes_.push_back(std::move(node));
    connect(moved);
    graph_.optimize(iterations_);
    const WallTime computed = WallTime::now();

    nav_msgs::OccupancyGrid::Ptr drawn;
    if ((nodes_.size() - 1) % render_every_ == 0) drawn = render();
    const WallTime rendered = WallTime::now();

    graph_slam::Timing timing;
    timing.header.stamp = scan_->header.stamp;
    timing.header.frame_id = frame_;
    timing.acquisition = (acquired - scan_received_).toSec();
    timing.computation = (computed - acquired).toSec();
    timing.rendering = (rendered - computed).toSec();
    timing_pub_.publish(timing);

    geometry_msgs::PoseStamped pose;
    pose.header = timing.header;
    pose.pose = toMessage(graph_.poses().back());
    pose_pub_.publish(pose);
    if (drawn) map_pub_.publish(drawn);
    ROS_DEBUG("%zu scans, %zu edges", nodes_.size(), graph_.edges());
  }

  // Puts the newest node into the graph, with edges by odometry and to all earlier ones that it fits.
  void connect(const Pose& moved) {
    if (graph_.poses().empty()) {
      graph_.add(Pose::Zero());
      return;
    }
    const size_t before = graph_.poses().size() - 1;
    Pose guess = graph_slam::compose(graph_.poses()[before], moved);
    const CSimplePointsMap& points = nodes_.back()->points;
    std::vector<graph_slam::PoseGraph::Edge> edges;
    const size_t self = graph_.add(guess);
    const double far = moved.head<2>().norm(), turned = std::abs(moved[2]);
    edges.push_back({before, self, moved, weight(0.05 + 0.1 * far, 0.02 + 0.1 * turned)});
    // From the newest to the oldest: what fits the scans just before makes a better guess for those long ago.
    for (size_t i = self; i-- > 0;) {
      const Pose& other = graph_.poses()[i];
      const Pose relative = graph_slam::between(other, guess);
      if (relative.head<2>().norm() > neighbourhood_) continue;
      if (nodes_[i]->points.empty() || points.empty()) continue;
      const graph_slam::Match match = graph_slam::matchScans(nodes_[i]->points, points, relative, kReach, headings_);
      const Pose correction = graph_slam::between(relative, match.pose);
      if (match.share < min_share_ || correction.head<2>().norm() > kReach || std::abs(correction[2]) > kReach / 2) {
        continue;
      }
      edges.push_back({i, self, match.pose, weight(0.02 + std::sqrt(match.error), 0.01)});
      if (i == before) guess = graph_slam::compose(other, match.pose);
    }
    for (const auto& edge : edges) graph_.add(edge);
    graph_.move(self, guess);
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
    scan.sensorPose = mrpt::poses::CPose3D(laser_[0], laser_[1], 0, laser_[2] + msg.angle_min + span / 2, 0, 0);
    scan.resizeScan(n);
    for (size_t i = 0; i < n; ++i) {
      const float range = msg.ranges[i];
      const bool valid = range >= msg.range_min && range < farthest;  // false for NaN
      scan.setScanRange(i, valid ? range : 0.0F);
      scan.setScanRangeValidity(i, valid);
    }
    return scan;
  }

  // Every pose may have moved: the map is drawn anew.
  nav_msgs::OccupancyGrid::Ptr render() {
    grid_.fill(0.5F);
    for (size_t i = 0; i < nodes_.size(); ++i) {
      if (nodes_[i]->points.empty()) continue;
      const Pose& pose = graph_.poses()[i];
      grid_.insertObservation(nodes_[i]->scan, mrpt::poses::CPose3D(pose[0], pose[1], 0, pose[2], 0, 0));
    }
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

  // A match may correct a guess by this much: metres; half as many radians.
  static constexpr double kReach = 0.8;

  ros::NodeHandle node_;
  ros::NodeHandle private_;
  const std::string frame_;
  const Pose laser_;
  const double max_range_;
  const double neighbourhood_;
  const int headings_;
  const double min_share_;
  const int iterations_;
  const int render_every_;
  const double odom_wait_;
  const ros::Duration odom_slack_;
  const Occupancy occupancy_;

  graph_slam::PoseGraph graph_;
  std::vector<std::unique_ptr<Node>> nodes_;
  COccupancyGridMap2D grid_;

  std::map<ros::Time, Pose> odoms_;  // the latest
  std::optional<Pose> odom_before_;  // at the scan before
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
  ros::init(argc, argv, "graph_slam");
  GraphSlam slam;
  slam.spin();
  return 0;
}
