// A compiled policy from C++: the single file of `ttscompile convert --single-file`, and onnxruntime. Nothing else.
//
//     episode MODEL.onnx FOLDER CALLS [THREADS]
//
// runs CALLS calls of one episode. Call r reads its inputs from FOLDER/r/NAME.bin, raw numbers in the machine's byte
// order: the observations, initial_noise, step_noise (if the sampler is stochastic), plan, rollout_keep; and, where there
// are such files, the plan's correction (correction.bin, correction_bias.bin and so on), without which nothing is
// corrected, and use_pruner.bin with the pruner's weights, without which the plan is that of plan.bin. The rollout cache
// is handed from call to call here. Prints one line of actions a call; times go to standard error.
#include <onnxruntime_c_api.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <functional>
#include <iterator>
#include <map>
#include <numeric>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

namespace {

const OrtApi* const ort = OrtGetApiBase()->GetApi(ORT_API_VERSION);

void check(OrtStatus* status) {
  if (status == nullptr) return;
  const std::string message = ort->GetErrorMessage(status);
  ort->ReleaseStatus(status);
  throw std::runtime_error("onnxruntime: " + message);
}

struct Input {
  ONNXTensorElementDataType type;
  std::vector<int64_t> shape;  // -1 where the model leaves it open
  bool optional;               // the model has a value for it
};

// Numbers of one tensor, and the tensor that reads them where they are.
struct Tensor {
  std::vector<char> bytes;
  std::vector<int64_t> shape;
  OrtValue* value = nullptr;
};

size_t size_of(ONNXTensorElementDataType type) {
  switch (type) {
    case ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT: return 4;
    case ONNX_TENSOR_ELEMENT_DATA_TYPE_INT32: return 4;
    case ONNX_TENSOR_ELEMENT_DATA_TYPE_DOUBLE: return 8;
    case ONNX_TENSOR_ELEMENT_DATA_TYPE_INT64: return 8;
    case ONNX_TENSOR_ELEMENT_DATA_TYPE_INT8: return 1;
    case ONNX_TENSOR_ELEMENT_DATA_TYPE_UINT8: return 1;
    case ONNX_TENSOR_ELEMENT_DATA_TYPE_BOOL: return 1;
    default: throw std::runtime_error("an input has an element type that this example does not read");
  }
}

int64_t product(const std::vector<int64_t>& shape) {
  return std::accumulate(shape.begin(), shape.end(), int64_t{1}, std::multiplies<>());
}

std::vector<char> read(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error("cannot read " + path);
  return {std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
}

void add_inputs(std::map<std::string, Input>& inputs, OrtSession* session, OrtAllocator* allocator, bool optional) {
  const auto counted = optional ? ort->SessionGetOverridableInitializerCount : ort->SessionGetInputCount;
  const auto named = optional ? ort->SessionGetOverridableInitializerName : ort->SessionGetInputName;
  const auto typed = optional ? ort->SessionGetOverridableInitializerTypeInfo : ort->SessionGetInputTypeInfo;
  size_t count = 0;
  check(counted(session, &count));
  for (size_t i = 0; i < count; ++i) {
    char* name = nullptr;
    OrtTypeInfo* info = nullptr;
    const OrtTensorTypeAndShapeInfo* tensor = nullptr;
    check(named(session, i, allocator, &name));
    check(typed(session, i, &info));
    check(ort->CastTypeInfoToTensorInfo(info, &tensor));
    Input input{};
    input.optional = optional;
    size_t rank = 0;
    check(ort->GetTensorElementType(tensor, &input.type));
    check(ort->GetDimensionsCount(tensor, &rank));
    input.shape.resize(rank);
    check(ort->GetDimensions(tensor, input.shape.data(), rank));
    inputs[name] = input;
    ort->ReleaseTypeInfo(info);
    check(ort->AllocatorFree(allocator, name));
  }
}

void wrap(Tensor& tensor, ONNXTensorElementDataType type, OrtMemoryInfo* memory) {
  if (tensor.value != nullptr) ort->ReleaseValue(tensor.value);
  static char nothing;  // an empty tensor wants an address too
  void* data = tensor.bytes.empty() ? &nothing : tensor.bytes.data();
  check(ort->CreateTensorWithDataAsOrtValue(memory, data, tensor.bytes.size(), tensor.shape.data(),
                                            tensor.shape.size(), type, &tensor.value));
}

// An input from its file; the number of streams follows from the file's length.
void load(Tensor& tensor, const Input& input, const std::string& path, OrtMemoryInfo* memory) {
  tensor.bytes = read(path);
  tensor.shape = input.shape;
  int64_t known = static_cast<int64_t>(size_of(input.type));
  for (int64_t n : input.shape) known *= n < 0 ? 1 : n;
  for (int64_t& n : tensor.shape) n = n < 0 ? static_cast<int64_t>(tensor.bytes.size()) / known : n;
  if (product(tensor.shape) * static_cast<int64_t>(size_of(input.type)) != static_cast<int64_t>(tensor.bytes.size()))
    throw std::runtime_error(path + " has not the size of its input");
  wrap(tensor, input.type, memory);
}

Tensor copy_of(const OrtValue* value, ONNXTensorElementDataType type) {
  OrtTensorTypeAndShapeInfo* info = nullptr;
  size_t rank = 0;
  check(ort->GetTensorTypeAndShape(value, &info));
  check(ort->GetDimensionsCount(info, &rank));
  Tensor tensor;
  tensor.shape.resize(rank);
  check(ort->GetDimensions(info, tensor.shape.data(), rank));
  ort->ReleaseTensorTypeAndShapeInfo(info);
  const void* data = nullptr;
  check(ort->GetTensorData(value, &data));
  const char* first = static_cast<const char*>(data);
  const size_t bytes = static_cast<size_t>(product(tensor.shape)) * size_of(type);
  if (bytes > 0) tensor.bytes.assign(first, first + bytes);
  return tensor;
}

// Whether the processor sums products of eight-bit integers in 32 bits; false where nothing says what it has.
bool has_integer_dot_product() {
#if defined(__x86_64__) || defined(__i386__)
  std::ifstream file("/proc/cpuinfo");
  for (std::string word; file >> word;)
    if (word == "avx512_vnni" || word == "avx_vnni" || word == "amx_int8") return true;
  return false;
#else
  return true;
#endif
}

void run(const std::string& model, const std::string& folder, int calls, int threads) {
  OrtEnv* env = nullptr;
  OrtSessionOptions* options = nullptr;
  OrtSession* session = nullptr;
  OrtAllocator* allocator = nullptr;
  OrtMemoryInfo* memory = nullptr;
  // Warnings are about optional inputs, which have values in the model.
  check(ort->CreateEnv(ORT_LOGGING_LEVEL_ERROR, "episode", &env));
  check(ort->CreateSessionOptions(&options));
  check(ort->SetIntraOpNumThreads(options, threads));
  // Threads look for work while a call is under way, and sleep between calls.
  check(ort->AddSessionConfigEntry(options, "session.force_spinning_stop", "1"));
  // Else a file in eight bits has these sums in 16 bits, which saturate. It changes nothing in fp32.
  if (!has_integer_dot_product()) check(ort->AddSessionConfigEntry(options, "session.x64quantprecision", "1"));
  check(ort->CreateSession(env, model.c_str(), options, &session));
  check(ort->GetAllocatorWithDefaultOptions(&allocator));
  check(ort->CreateCpuMemoryInfo(OrtArenaAllocator, OrtMemTypeDefault, &memory));

  std::map<std::string, Input> inputs;
  add_inputs(inputs, session, allocator, false);
  add_inputs(inputs, session, allocator, true);
  const std::vector<const char*> outputs = {"action", "rollout_rows_next", "rollout_index_next"};
  std::map<std::string, Tensor> tensors;
  for (int r = 0; r < calls; ++r) {
    std::vector<const char*> names;
    std::vector<const OrtValue*> values;
    for (const auto& [name, input] : inputs) {
      if (name == "rollout_rows" || name == "rollout_index") continue;
      const std::string path = folder + "/" + std::to_string(r) + "/" + name + ".bin";
      if (!input.optional || std::ifstream(path)) {
        load(tensors[name], input, path, memory);
      } else if (const auto earlier = tensors.find(name); earlier != tensors.end()) {  // it was in the call before
        ort->ReleaseValue(earlier->second.value);
        tensors.erase(earlier);
      }
    }
    if (r == 0) {  // a new episode: no residuals yet
      Tensor& rows = tensors["rollout_rows"];
      rows.shape = inputs.at("rollout_rows").shape;
      rows.shape[0] = 0;
      wrap(rows, ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT, memory);
      Tensor& index = tensors["rollout_index"];
      index.shape = inputs.at("rollout_index").shape;
      index.shape[0] = tensors["initial_noise"].shape[0];  // streams
      index.bytes.assign(static_cast<size_t>(product(index.shape)) * 8, '\xff');  // -1 everywhere
      wrap(index, ONNX_TENSOR_ELEMENT_DATA_TYPE_INT64, memory);
    }
    for (const auto& [name, tensor] : tensors) {
      names.push_back(name.c_str());
      values.push_back(tensor.value);
    }
    std::vector<OrtValue*> results(outputs.size(), nullptr);
    const auto start = std::chrono::steady_clock::now();
    check(ort->Run(session, nullptr, names.data(), values.data(), names.size(), outputs.data(), outputs.size(),
                   results.data()));
    const std::chrono::duration<double, std::milli> took = std::chrono::steady_clock::now() - start;
    std::fprintf(stderr, "call %d: %.1f ms\n", r, took.count());

    const Tensor action = copy_of(results[0], ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT);
    const float* numbers = reinterpret_cast<const float*>(action.bytes.data());
    for (int64_t i = 0; i < product(action.shape); ++i) std::printf(i == 0 ? "%.9g" : " %.9g", numbers[i]);
    std::printf("\n");
    for (const auto& [name, result, type] :
         {std::make_tuple("rollout_rows", results[1], ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT),
          std::make_tuple("rollout_index", results[2], ONNX_TENSOR_ELEMENT_DATA_TYPE_INT64)}) {
      Tensor next = copy_of(result, type);
      ort->ReleaseValue(tensors[name].value);
      tensors[name] = std::move(next);
      wrap(tensors[name], type, memory);
    }
    for (OrtValue* result : results) ort->ReleaseValue(result);
  }
  for (auto& [name, tensor] : tensors) ort->ReleaseValue(tensor.value);
  ort->ReleaseMemoryInfo(memory);
  ort->ReleaseSession(session);
  ort->ReleaseSessionOptions(options);
  ort->ReleaseEnv(env);
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 4) {
    std::fprintf(stderr, "usage: episode MODEL.onnx FOLDER CALLS [THREADS]\n");
    return 2;
  }
  if (ort == nullptr) {
    std::fprintf(stderr, "libonnxruntime is older than its headers: it has no API %d\n", ORT_API_VERSION);
    return 1;
  }
  try {
    run(argv[1], argv[2], std::stoi(argv[3]), argc > 4 ? std::stoi(argv[4]) : 1);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
  return 0;
}
