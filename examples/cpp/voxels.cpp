#include "voxels.h"

#include <cmath>
#include <fstream>
#include <iterator>
#include <cstring>
#include <stdexcept>
#include <unordered_map>

std::vector<float> read_bin(const std::string& path, int64_t columns) {
  std::ifstream stream(path, std::ios::binary);
  if (!stream) throw std::runtime_error(path + " cannot be read");
  const std::string content((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
  if (content.size() % (4 * size_t(columns)) != 0) {
    throw std::runtime_error(path + " must hold whole points of " + std::to_string(columns) + " float32 numbers, but has " +
                             std::to_string(content.size()) + " bytes");
  }
  std::vector<float> points(content.size() / 4);
  std::memcpy(points.data(), content.data(), content.size());
  return points;
}

Voxels gather(const std::vector<float>& points, const Settings& settings) {
  const auto& [nx, ny, nz] = settings.cells;
  const size_t columns = size_t(settings.columns);
  std::unordered_map<int64_t, int64_t> rows;  // cell -> voxel
  std::vector<int64_t> count;                 // points of each voxel
  Voxels found;
  for (size_t i = 0; i + columns <= points.size(); i += columns) {
    float at[3];
    bool inside = true;
    for (int axis = 0; axis < 3; ++axis) {
      at[axis] = std::floor((points[i + axis] - settings.minimum[axis]) / settings.cell[axis]);
      inside = inside && at[axis] >= 0 && at[axis] < float(settings.cells[axis]);  // false for NaN
    }
    if (!inside) continue;
    const int64_t x = int64_t(at[0]), y = int64_t(at[1]), z = int64_t(at[2]);
    auto place = rows.find((z * ny + y) * nx + x);
    if (place == rows.end()) {
      if (settings.max_voxels > 0 && int64_t(count.size()) >= settings.max_voxels) continue;
      place = rows.emplace((z * ny + y) * nx + x, int64_t(count.size())).first;
      count.push_back(0);
      found.index.insert(found.index.end(), {z, y, x});
    }
    if (settings.max_points > 0 && count[place->second] >= settings.max_points) continue;
    ++count[place->second];
    found.voxel.push_back(place->second);
    for (size_t k = 0; k < columns; ++k) {
      const float value = points[i + k];
      found.points.push_back(std::isfinite(value) ? value : 0.0f);  // an unknown intensity counts as 0
    }
  }
  (void)nz;
  return found;
}
