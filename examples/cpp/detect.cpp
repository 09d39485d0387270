// Reads a sweep and prints what an exported detector finds in it, best first:  name score x y z l w h yaw
//
//   beambox_detect pointpillars.onnx scan.bin
#include <cstdio>
#include <exception>
#include <fstream>
#include <iterator>
#include <stdexcept>
#include <string>

#include "boxes.h"
#include "network.h"
#include "settings.h"
#include "voxels.h"

int main(int argc, char** argv) {
  if (argc != 3) {
    std::fprintf(stderr, "usage: %s MODEL.onnx SCAN.bin\n", argv[0]);
    return 2;
  }
  try {
    std::ifstream stream(argv[1], std::ios::binary);
    if (!stream) throw std::runtime_error(std::string(argv[1]) + " cannot be read");
    const std::string content((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
    const Settings settings = read_settings(content);
    const auto points = read_bin(argv[2], settings.columns);
    Voxels voxels = gather(points, settings);
    if (voxels.voxel.empty()) return 0;  // nothing to see, nothing found
    const Outputs outputs = open_network(argv[1])->run(voxels, size_t(settings.columns));
    if (outputs.classes != settings.classes.size()) throw std::runtime_error("scores and names of classes differ in number");
    for (const Box& box : detections(outputs, settings)) {
      std::printf("%s %.6f", settings.classes[box.label].c_str(), double(box.score));
      for (const float value : box.values) std::printf(" %.6f", double(value));
      std::printf("\n");
    }
  } catch (const std::exception& error) {
    std::fprintf(stderr, "beambox_detect: %s\n", error.what());
    return 2;
  }
  return 0;
}
