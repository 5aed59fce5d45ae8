// Copyright the Cloudroid authors. SPDX-License-Identifier: Apache-2.0
#include "detector.h"

#include <opencv2/imgproc.hpp>

namespace object_detector {

namespace {

// The classes of COCO, in the network's order.
const char* const kLabels[] = {
    "person",        "bicycle",      "car",          "motorcycle",    "airplane",      "bus",
    "train",         "truck",        "boat",         "traffic light", "fire hydrant",  "stop sign",
    "parking meter", "bench",        "bird",         "cat",           "dog",           "horse",
    "sheep",         "cow",          "elephant",     "bear",          "zebra",         "giraffe",
    "backpack",      "umbrella",     "handbag",      "tie",           "suitcase",      "frisbee",
    "skis",          "snowboard",    "sports ball",  "kite",          "baseball bat",  "baseball glove",
    "skateboard",    "surfboard",    "tennis racket", "bottle",       "wine glass",    "cup",
    "fork",          "knife",        "spoon",        "bowl",          "banana",        "apple",
    "sandwich",      "orange",       "broccoli",     "carrot",        "hot dog",       "pizza",
    "donut",         "cake",         "chair",        "couch",         "potted plant",  "bed",
    "dining table",  "toilet",       "tv",           "laptop",        "mouse",         "remote",
    "keyboard",      "cell phone",   "microwave",    "oven",          "toaster",       "sink",
    "refrigerator",  "book",         "clock",        "vase",          "scissors",      "teddy bear",
    "hair drier",    "toothbrush"};
constexpr int kClasses = sizeof(kLabels) / sizeof(*kLabels);
constexpr int kCell = 4;  // pixels of the scaled image

}  // namespace

Detector::Detector(const std::string& model, cv::Size size, float min_score, float overlap)
    : net_(cv::dnn::readNetFromONNX(model)), size_(size), min_score_(min_score), overlap_(overlap) {
  CV_Assert(size.width > 0 && size.height > 0 && size.width % 32 == 0 && size.height % 32 == 0);
  net_.setPreferableBackend(cv::dnn::DNN_BACKEND_OPENCV);
  net_.setPreferableTarget(cv::dnn::DNN_TARGET_CPU);
}

void Detector::prepare(const cv::Mat& image, bool is_bgr) {
  scale_ = cv::Size2f(static_cast<float>(image.cols) / size_.width, static_cast<float>(image.rows) / size_.height);
  net_.setInput(cv::dnn::blobFromImage(image, 1.0, size_, cv::Scalar(), is_bgr, false));
}

void Detector::compute() { net_.forward(outputs_, std::vector<cv::String>{"heat", "wh"}); }

std::vector<Found> Detector::find() const {
  const cv::Mat& heat = outputs_.at(0);
  const cv::Mat& sides = outputs_.at(1);
  CV_Assert(heat.dims == 4 && heat.size[1] == kClasses && sides.dims == 4 && sides.size[1] == 4);
  const int rows = heat.size[2], columns = heat.size[3];
  const auto side = [&](int which, int y, int x) { return sides.ptr<float>(0, which)[y * columns + x]; };

  std::vector<cv::Rect2d> boxes;
  std::vector<float> scores;
  std::vector<int> classes;
  cv::Mat highest;
  for (int c = 0; c < kClasses; ++c) {
    const cv::Mat map(rows, columns, CV_32F, const_cast<float*>(heat.ptr<float>(0, c)));
    double best;
    cv::minMaxLoc(map, nullptr, &best);
    if (best < min_score_) continue;
    // A centre is higher than all around it.
    cv::dilate(map, highest, cv::Mat::ones(3, 3, CV_8U));
    for (int y = 0; y < rows; ++y) {
      for (int x = 0; x < columns; ++x) {
        const float score = map.at<float>(y, x);
        if (score < min_score_ || score < highest.at<float>(y, x)) continue;
        const float left = side(0, y, x), top = side(1, y, x), right = side(2, y, x), bottom = side(3, y, x);
        boxes.emplace_back((kCell * x - left) * scale_.width, (kCell * y - top) * scale_.height,
                           (left + right) * scale_.width, (top + bottom) * scale_.height);
        scores.push_back(score);
        classes.push_back(c);
      }
    }
  }
  std::vector<int> kept;
  cv::dnn::NMSBoxes(boxes, scores, min_score_, overlap_, kept);
  std::vector<Found> found;
  for (const int i : kept) found.push_back({kLabels[classes[i]], scores[i], cv::Rect2f(boxes[i])});
  return found;
}

}  // namespace object_detector
