// Copyright the Cloudroid authors. SPDX-License-Identifier: Apache-2.0
//
// Detects objects in images.

#include <object_detector/Detections.h>
#include <object_detector/Timing.h>
#include <ros/package.h>
#include <ros/ros.h>
#include <sensor_msgs/Image.h>
#include <sensor_msgs/image_encodings.h>

#include <cstdio>
#include <memory>
#include <opencv2/core/utility.hpp>
#include <string>

#include "detector.h"

namespace {

using ros::WallTime;

class ObjectDetector {
 public:
  ObjectDetector() : private_("~") {
    const auto model = private_.param<std::string>(
        "model", ros::package::getPath("object_detector") + "/models/centernet.onnx");
    const cv::Size size(private_.param("width", 512), private_.param("height", 512));
    // On a machine that others use as well, more threads than processors wait for each other.
    cv::setNumThreads(private_.param("threads", 1));
    detector_ = std::make_unique<object_detector::Detector>(
        model, size, private_.param("min_score", 0.4F), private_.param("overlap", 0.5F));
    timing_pub_ = private_.advertise<object_detector::Timing>("timing", 10);
    detections_pub_ = private_.advertise<object_detector::Detections>("detections", 10);
    image_sub_ = node_.subscribe("image", 1, &ObjectDetector::imageReceived, this);
  }

 private:
  void imageReceived(const sensor_msgs::Image::ConstPtr& msg) {
    const WallTime begun = WallTime::now();
    const bool is_bgr = msg->encoding == sensor_msgs::image_encodings::BGR8;
    if (!is_bgr && msg->encoding != sensor_msgs::image_encodings::RGB8) {
      ROS_WARN_THROTTLE(10.0, "images must be bgr8 or rgb8, not '%s'", msg->encoding.c_str());
      return;
    }
    const size_t step = msg->step;
    if (msg->width == 0 || msg->height == 0 || step < size_t{3} * msg->width || msg->data.size() < step * msg->height) {
      ROS_WARN_THROTTLE(10.0, "an image of %ux%u with %zu bytes", msg->width, msg->height, msg->data.size());
      return;
    }
    const cv::Mat image(static_cast<int>(msg->height), static_cast<int>(msg->width), CV_8UC3,
                        const_cast<uint8_t*>(msg->data.data()), step);
    detector_->prepare(image, is_bgr);
    const WallTime acquired = WallTime::now();
    detector_->compute();
    const WallTime computed = WallTime::now();

    object_detector::Detections detections;
    detections.header = msg->header;
    for (const auto& found : detector_->find()) {
      object_detector::Detection detection;
      detection.label = found.label;
      detection.score = found.score;
      detection.x = found.box.x;
      detection.y = found.box.y;
      detection.width = found.box.width;
      detection.height = found.box.height;
      detections.detections.push_back(detection);
    }
    const WallTime rendered = WallTime::now();

    object_detector::Timing timing;
    timing.header = msg->header;
    timing.acquisition = (acquired - begun).toSec();
    timing.computation = (computed - acquired).toSec();
    timing.rendering = (rendered - computed).toSec();
    timing_pub_.publish(timing);
    detections_pub_.publish(detections);
  }

  ros::NodeHandle node_;
  ros::NodeHandle private_;
  std::unique_ptr<object_detector::Detector> detector_;
  ros::Publisher timing_pub_;
  ros::Publisher detections_pub_;
  ros::Subscriber image_sub_;
};

}  // namespace

int main(int argc, char** argv) {
  ros::init(argc, argv, "object_detector");
  try {
    ObjectDetector detector;
    ros::spin();
  } catch (const cv::Exception& error) {
    std::fprintf(stderr, "object_detector: the model cannot be used: %s\n", error.what());
    return 1;
  }
  return 0;
}
