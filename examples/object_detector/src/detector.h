// Copyright the Cloudroid authors. SPDX-License-Identifier: Apache-2.0
#pragma once

#include <opencv2/core.hpp>
#include <opencv2/dnn.hpp>
#include <string>
#include <vector>

namespace object_detector {

struct Found {
  const char* label;
  float score;
  cv::Rect2f box;  // in pixels of the image
};

// A network of the kind CenterNet: for each class a map of how likely the centre of such a thing is there, and one of
// the distances from the centre to the four sides.
class Detector {
 public:
  // `size`: to what images are scaled, multiples of 32. Throws cv::Exception if the model cannot be used.
  Detector(const std::string& model, cv::Size size, float min_score, float overlap);

  // The three steps, one after the other.
  void prepare(const cv::Mat& image, bool is_bgr);
  void compute();
  std::vector<Found> find() const;

 private:
  cv::dnn::Net net_;
  const cv::Size size_;
  const float min_score_;
  const float overlap_;
  cv::Size2f scale_;
  std::vector<cv::Mat> outputs_;
};

}  // namespace object_detector
