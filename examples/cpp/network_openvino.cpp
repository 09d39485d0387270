#include <openvino/openvino.hpp>

#include "network.h"

namespace {

class OpenVino : public Network {
 public:
  explicit OpenVino(const std::string& path)
      : model_(core_.compile_model(path, "CPU",
                                   {ov::hint::inference_precision(ov::element::f32),
                                    ov::hint::execution_mode(ov::hint::ExecutionMode::ACCURACY)})) {}

  Outputs run(Voxels& voxels, size_t columns) override {
    const size_t n = voxels.voxel.size(), v = voxels.index.size() / 3;
    ov::InferRequest request = model_.create_infer_request();
    request.set_tensor("points", ov::Tensor(ov::element::f32, {n, columns}, voxels.points.data()));
    request.set_tensor("voxel", ov::Tensor(ov::element::i64, {n}, voxels.voxel.data()));
    request.set_tensor("index", ov::Tensor(ov::element::i64, {v, 3}, voxels.index.data()));
    request.infer();
    const ov::Tensor boxes = request.get_tensor("boxes"), scores = request.get_tensor("scores");
    Outputs outputs;
    outputs.rows = scores.get_shape()[0];
    outputs.classes = scores.get_shape()[1];
    outputs.boxes.assign(boxes.data<const float>(), boxes.data<const float>() + boxes.get_size());
    outputs.scores.assign(scores.data<const float>(), scores.data<const float>() + scores.get_size());
    return outputs;
  }

 private:
  ov::Core core_;
  ov::CompiledModel model_;
};

}  // namespace

std::unique_ptr<Network> open_network(const std::string& path) { return std::make_unique<OpenVino>(path); }
