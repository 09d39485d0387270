#include "boxes.h"

#include <algorithm>
#include <cmath>

namespace {

struct Point {
  double x, y;
};

// Corners of b in the frame of a, counter-clockwise.
std::vector<Point> corners_in_frame(const Box& a, const Box& b) {
  const double cosine = std::cos(double(a.values[6])), sine = std::sin(double(a.values[6]));
  const double dx = double(b.values[0]) - a.values[0], dy = double(b.values[1]) - a.values[1];
  const double turn = double(b.values[6]) - a.values[6];
  const double along = std::max(0.0, double(b.values[3])) / 2, across = std::max(0.0, double(b.values[4])) / 2;
  std::vector<Point> corners;
  for (const auto& [u, v] : {Point{1, 1}, Point{-1, 1}, Point{-1, -1}, Point{1, -1}}) {
    corners.push_back({cosine * dx + sine * dy + std::cos(turn) * u * along - std::sin(turn) * v * across,
                       cosine * dy - sine * dx + std::sin(turn) * u * along + std::cos(turn) * v * across});
  }
  return corners;
}

// The part of a convex polygon where nx * x + ny * y <= limit (Sutherland and Hodgman, 1974).
std::vector<Point> clip(const std::vector<Point>& polygon, double nx, double ny, double limit) {
  std::vector<Point> kept;
  for (size_t i = 0; i < polygon.size(); ++i) {
    const Point& p = polygon[i];
    const Point& q = polygon[(i + 1) % polygon.size()];
    const double at_p = nx * p.x + ny * p.y - limit, at_q = nx * q.x + ny * q.y - limit;
    if (at_p <= 0) kept.push_back(p);
    if ((at_p <= 0) != (at_q <= 0)) {
      const double part = at_p / (at_p - at_q);
      kept.push_back({p.x + part * (q.x - p.x), p.y + part * (q.y - p.y)});
    }
  }
  return kept;
}

double area(const Box& box) { return std::max(0.0, double(box.values[3])) * std::max(0.0, double(box.values[4])); }

}  // namespace

double shared_area(const Box& a, const Box& b) {
  const double length = std::max(0.0, double(a.values[3])) / 2, width = std::max(0.0, double(a.values[4])) / 2;
  auto polygon = corners_in_frame(a, b);
  polygon = clip(polygon, 1, 0, length);
  polygon = clip(polygon, -1, 0, length);
  polygon = clip(polygon, 0, 1, width);
  polygon = clip(polygon, 0, -1, width);
  double doubled = 0;
  for (size_t i = 0; i < polygon.size(); ++i) {
    const Point& p = polygon[i];
    const Point& q = polygon[(i + 1) % polygon.size()];
    doubled += p.x * q.y - p.y * q.x;
  }
  return std::max(0.0, doubled / 2);
}

std::vector<Box> detections(const Outputs& outputs, const Settings& settings) {
  std::vector<Box> best;
  for (size_t row = 0; row < outputs.rows; ++row) {
    const float* scores = &outputs.scores[row * outputs.classes];
    const size_t label = size_t(std::max_element(scores, scores + outputs.classes) - scores);
    if (!(scores[label] >= float(settings.score_threshold))) continue;
    Box box{{}, scores[label], label};
    std::copy_n(&outputs.boxes[row * 7], 7, box.values.begin());
    best.push_back(box);
  }
  std::stable_sort(best.begin(), best.end(), [](const Box& a, const Box& b) { return a.score > b.score; });
  if (int64_t(best.size()) > settings.nms_pre) best.resize(size_t(settings.nms_pre));
  std::vector<Box> kept;
  for (const Box& box : best) {
    if (int64_t(kept.size()) == settings.nms_post) break;
    const bool free = std::none_of(kept.begin(), kept.end(), [&](const Box& other) {
      const double shared = shared_area(other, box), whole = area(other) + area(box) - shared;
      return whole > 0 && shared / whole > settings.nms_iou;
    });
    if (free) kept.push_back(box);
  }
  return kept;
}
