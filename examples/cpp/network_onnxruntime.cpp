#include <onnxruntime_cxx_api.h>

#include <array>

#include "network.h"

namespace {

class OnnxRuntime : public Network {
 public:
  explicit OnnxRuntime(const std::string& path)
      : environment_(ORT_LOGGING_LEVEL_ERROR, "beambox"), session_(environment_, path.c_str(), Ort::SessionOptions{}) {}

  Outputs run(Voxels& voxels, size_t columns) override {
    const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    const auto n = int64_t(voxels.voxel.size()), v = int64_t(voxels.index.size() / 3);
    const std::array<int64_t, 2> points_shape{n, int64_t(columns)}, index_shape{v, 3};
    const std::array<int64_t, 1> voxel_shape{n};
    std::array<Ort::Value, 3> inputs{
        Ort::Value::CreateTensor<float>(memory, voxels.points.data(), voxels.points.size(), points_shape.data(), 2),
        Ort::Value::CreateTensor<int64_t>(memory, voxels.voxel.data(), voxels.voxel.size(), voxel_shape.data(), 1),
        Ort::Value::CreateTensor<int64_t>(memory, voxels.index.data(), voxels.index.size(), index_shape.data(), 2)};
    const char* names[] = {"points", "voxel", "index"};
    const char* wanted[] = {"boxes", "scores"};
    auto found = session_.Run(Ort::RunOptions{nullptr}, names, inputs.data(), 3, wanted, 2);
    const auto shape = found[1].GetTensorTypeAndShapeInfo().GetShape();
    Outputs outputs;
    outputs.rows = size_t(shape[0]);
    outputs.classes = size_t(shape[1]);
    const float* boxes = found[0].GetTensorData<float>();
    const float* scores = found[1].GetTensorData<float>();
    outputs.boxes.assign(boxes, boxes + outputs.rows * 7);
    outputs.scores.assign(scores, scores + outputs.rows * outputs.classes);
    return outputs;
  }

 private:
  Ort::Env environment_;
  Ort::Session session_;
};

}  // namespace

std::unique_ptr<Network> open_network(const std::string& path) { return std::make_unique<OnnxRuntime>(path); }
