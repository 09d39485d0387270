// Points gathered into voxels, as docs/export.md says under "Before".
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "settings.h"

struct Voxels {
  std::vector<float> points;   // (N, columns) that were kept
  std::vector<int64_t> voxel;  // (N) row of index that each belongs to
  std::vector<int64_t> index;  // (V, 3) cells z, y, x
};

// Reads little-endian float32 x, y, z, intensity; throws where the size is not a whole number of points.
std::vector<float> read_bin(const std::string& path, int64_t columns);

Voxels gather(const std::vector<float>& points, const Settings& settings);
