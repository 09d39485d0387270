#include "settings.h"

#include <sstream>
#include <stdexcept>

namespace {

// A cursor over protobuf's wire format: https://protobuf.dev/programming-guides/encoding/
struct Wire {
  const unsigned char* at;
  const unsigned char* end;

  uint64_t varint() {
    uint64_t value = 0;
    for (int shift = 0; shift < 64 && at < end; shift += 7) {
      const unsigned char byte = *at++;
      value |= uint64_t(byte & 0x7f) << shift;
      if (!(byte & 0x80)) return value;
    }
    throw std::runtime_error("the file is cut short, or no ONNX file");
  }

  // The next field: its number, and its bytes where it has a length.
  bool next(uint64_t& number, std::string& bytes) {
    if (at >= end) return false;
    const uint64_t tag = varint();
    number = tag >> 3;
    bytes.clear();
    uint64_t length = 0;
    switch (tag & 7) {
      case 0: varint(); return true;
      case 1: length = 8; break;
      case 2: length = varint(); break;
      case 5: length = 4; break;
      default: throw std::runtime_error("the file is no ONNX file");
    }
    if (length > uint64_t(end - at)) throw std::runtime_error("the file is cut short, or no ONNX file");
    // the graph, field 7 of a ModelProto, holds the weights and is not copied
    if ((tag & 7) == 2 && number != 7) bytes.assign(reinterpret_cast<const char*>(at), size_t(length));
    at += length;
    return true;
  }
};

Wire wire(const std::string& bytes) {
  const auto* begin = reinterpret_cast<const unsigned char*>(bytes.data());
  return {begin, begin + bytes.size()};
}

// ModelProto.metadata_props is field 14, its entries have the fields 1 (key) and 2 (value): onnx.proto of ONNX.
std::string metadata(const std::string& content, const std::string& wanted) {
  Wire model = wire(content);
  uint64_t number = 0;
  std::string bytes;
  while (model.next(number, bytes)) {
    if (number != 14) continue;
    const std::string entry = bytes;
    Wire parts = wire(entry);
    std::string key, value;
    while (parts.next(number, bytes)) (number == 1 ? key : value) = bytes;
    if (key == wanted) return value;
  }
  throw std::runtime_error("the file has no metadata \"" + wanted + "\": expected one that `beambox export` wrote");
}

}  // namespace

Settings read_settings(const std::string& content) {
  std::istringstream lines(metadata(content, "beambox-plain"));
  Settings found;
  for (std::string line; std::getline(lines, line);) {
    std::istringstream words(line);
    std::string key;
    words >> key;
    if (key == "class") {
      found.classes.push_back(line.substr(6));
    } else if (key == "minimum") {
      words >> found.minimum[0] >> found.minimum[1] >> found.minimum[2];
    } else if (key == "cell") {
      words >> found.cell[0] >> found.cell[1] >> found.cell[2];
    } else if (key == "cells") {
      words >> found.cells[0] >> found.cells[1] >> found.cells[2];
    } else if (key == "columns") {
      words >> found.columns;
    } else if (key == "max_points") {
      words >> found.max_points;
    } else if (key == "max_voxels") {
      words >> found.max_voxels;
    } else if (key == "score_threshold") {
      words >> found.score_threshold;
    } else if (key == "nms_iou") {
      words >> found.nms_iou;
    } else if (key == "nms_pre") {
      words >> found.nms_pre;
    } else if (key == "nms_post") {
      words >> found.nms_post;
    }
    if (words.fail()) throw std::runtime_error("the file's settings cannot be read: " + line);
  }
  return found;
}
