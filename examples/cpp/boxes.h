// From the rows of a network to detections, as docs/export.md says under "After".
#pragma once

#include <array>
#include <vector>

#include "network.h"
#include "settings.h"

struct Box {
  std::array<float, 7> values;  // x, y, z, l, w, h, yaw
  float score;
  size_t label;
};

// The area that two boxes share, seen from above, square metres.
double shared_area(const Box& a, const Box& b);

std::vector<Box> detections(const Outputs& outputs, const Settings& settings);
