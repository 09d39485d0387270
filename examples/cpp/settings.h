// What an exported file says of itself: the metadata "beambox-plain" of docs/export.md.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

struct Settings {
  std::vector<std::string> classes;
  int64_t columns = 4;                    // values of a point
  std::array<float, 3> minimum{}, cell{};  // x, y, z in metres
  std::array<int64_t, 3> cells{};          // number of cells in x, y, z
  int64_t max_points = 0, max_voxels = 0;  // 0: no limit
  double score_threshold = 0, nms_iou = 0;
  int64_t nms_pre = 0, nms_post = 0;
};

// Reads them from the bytes of an .onnx file; throws std::runtime_error where it is none of beambox's.
Settings read_settings(const std::string& content);
