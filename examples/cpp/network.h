// The one thing that a runtime has to do.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "voxels.h"

struct Outputs {
  std::vector<float> boxes;   // (A, 7) x, y, z, l, w, h, yaw
  std::vector<float> scores;  // (A, K)
  size_t rows = 0;            // A
  size_t classes = 0;         // K, whatever the file has
};

class Network {
 public:
  virtual ~Network() = default;
  virtual Outputs run(Voxels& voxels, size_t columns) = 0;
};

std::unique_ptr<Network> open_network(const std::string& path);
