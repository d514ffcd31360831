// An exported decision in ONNX: it decides, and learns nothing.
#include <cstdlib>
#include <cstring>

#include "files.hpp"
#include "model.hpp"
#include "ort.hpp"

const char* const RUNTIME = "onnxruntime";
const char* const PROGRAM = "dengine-onnx";

static std::vector<std::string> libraries() {
    if (const char* named = std::getenv("DENGINE_ONNXRUNTIME"); named != nullptr && *named != '\0') return {named};
    return {"libonnxruntime.so.1", "libonnxruntime.so"};
}

class OnnxModel final : public Model {
  public:
    OnnxModel(const std::string& path, const std::string& key)
        : bytes_(checked_bytes(path, key, sum)), runtime_(libraries()) {
        learns = false;
        open();
        const Metadata metadata = description();
        read(metadata);
        shape.any_length = false;  // the graph has one
        std::vector<float> trace = floats(metadata.list("golden.trace")), expected = floats(metadata.list("golden.embedding"));
        const bool golden = !expected.empty();  // earlier files have none
        if (!golden) trace.assign(shape.size(), 0.0F);
        if (trace.size() != shape.size() || (golden && expected.size() != width)) {
            throw Fault(DENGINE_BAD_MODEL, "its golden trace does not fit its own TraceSpec");
        }
        for (int i = 0; i < WARM_UP; ++i) must_agree(decide(trace, "").embedding, expected);
        bytes_.clear();
        bytes_.shrink_to_fit();
    }

    Decision decide(std::vector<float>& x, const std::string&) override {
        const std::int64_t sizes[] = {static_cast<std::int64_t>(shape.channels), static_cast<std::int64_t>(shape.samples)};
        Values values(runtime_);
        ort::Object trace = nullptr;
        check(runtime_.CreateTensorWithDataAsOrtValue(own_.memory, static_cast<void*>(x.data()), x.size() * sizeof(float), sizes,
                                                      std::size_t{2}, ort::FLOAT, &trace));
        values.held.push_back(trace);
        ort::Object found[7] = {};
        const char* const input[] = {"trace"};
        const char* const output[] = {"action", "reason", "lower", "upper", "n_success", "n_failure", "embedding"};
        const ort::Object given[] = {trace};
        const ort::Status status = runtime_.Run(own_.session, nullptr, input, given, std::size_t{1}, output, std::size_t{7}, found);
        values.held.insert(values.held.end(), found, found + 7);
        check(status);
        Decision said;
        said.action = one<std::int64_t>(found[0], ort::INT64);
        said.reason = reasons.at(static_cast<std::size_t>(one<std::int64_t>(found[1], ort::INT64)));
        said.lower = one<double>(found[2], ort::DOUBLE);
        said.upper = one<double>(found[3], ort::DOUBLE);
        said.n_success = one<std::int64_t>(found[4], ort::INT64);
        said.n_failure = one<std::int64_t>(found[5], ort::INT64);
        const float* z = data<float>(found[6], ort::FLOAT, width);
        said.embedding.assign(z, z + width);
        if (said.action < VERIFY || said.action > REJECT) throw Fault(DENGINE_FAILED, "the model gave no action");
        return said;
    }

    void tell(std::vector<float>&, const std::string&, std::int64_t, bool) override { refuse(); }
    void restore(std::vector<float>&, const std::string&, std::int64_t, const std::string&, double, double) override { refuse(); }
    void set_unreported(std::int64_t) override { refuse(); }
    void drop() override {}
    void settle() override {}
    std::int64_t predicted() override { return VERIFY; }
    std::int64_t unreported() override { return 0; }

  private:
    struct Values {
        explicit Values(const ort::Runtime& runtime) : runtime(runtime) {}
        ~Values() {
            for (const auto value : held) {
                if (value != nullptr) runtime.ReleaseValue(value);
            }
        }
        const ort::Runtime& runtime;
        std::vector<ort::Object> held;
    };

    [[noreturn]] static void refuse() { throw Fault(DENGINE_BAD_LABEL, "a model in ONNX learns nothing; export TorchScript"); }

    void check(ort::Status status, int code = DENGINE_FAILED) const { runtime_.check(status, code); }

    void open() {
        check(runtime_.CreateEnv(ort::ERROR_WARNING + 1, static_cast<const char*>("dengine"), &own_.environment));
        check(runtime_.CreateSessionOptions(&own_.options));
        check(runtime_.SetIntraOpNumThreads(own_.options, 1));
        check(runtime_.SetInterOpNumThreads(own_.options, 1));
        check(runtime_.SetSessionLogSeverityLevel(own_.options, 3));
        check(runtime_.CreateCpuMemoryInfo(ort::ARENA, ort::DEFAULT_MEMORY, &own_.memory));
        try {
            const auto status = runtime_.CreateSessionFromArray(own_.environment, static_cast<const void*>(bytes_.data()),
                                                                bytes_.size(), own_.options, &own_.session);
            check(status, DENGINE_BAD_MODEL);
        } catch (const Fault& fault) {
            throw Fault(DENGINE_BAD_MODEL, std::string("it has its checksum but is no loadable ONNX: ") + fault.what());
        }
    }

    Metadata description() const {
        ort::Object metadata = nullptr, allocator = nullptr;
        check(runtime_.SessionGetModelMetadata(own_.session, &metadata));
        char* json = nullptr;  // of the default allocator, once in a program's life: it is not given back
        check(runtime_.GetAllocatorWithDefaultOptions(&allocator));
        const auto status = runtime_.ModelMetadataLookupCustomMetadataMap(metadata, allocator, "dengine.json", &json);
        runtime_.ReleaseModelMetadata(metadata);
        check(status);
        if (json == nullptr) throw Fault(DENGINE_BAD_MODEL, "it is not a dengine export: it holds no dengine.json");
        return Metadata(json);
    }

    template <typename Number>
    const Number* data(ort::Object value, int type, std::size_t n) const {
        ort::Object about = nullptr;
        check(runtime_.GetTensorTypeAndShape(value, &about));
        int found = 0;
        std::size_t count = 0;
        const auto one = runtime_.GetTensorElementType(about, &found);
        const auto other = runtime_.GetTensorShapeElementCount(about, &count);
        runtime_.ReleaseTensorTypeAndShapeInfo(about);
        check(one);
        check(other);
        if (found != type || count != n) throw Fault(DENGINE_BAD_MODEL, "its outputs are of other types than a decision's");
        void* first = nullptr;
        check(runtime_.GetTensorMutableData(value, &first));
        return static_cast<const Number*>(first);
    }

    template <typename Number>
    Number one(ort::Object value, int type) const {
        return *data<Number>(value, type, 1);
    }

    struct Handles {
        explicit Handles(const ort::Runtime& runtime) : runtime(runtime) {}
        ~Handles() {
            if (memory != nullptr) runtime.ReleaseMemoryInfo(memory);
            if (session != nullptr) runtime.ReleaseSession(session);
            if (options != nullptr) runtime.ReleaseSessionOptions(options);
            if (environment != nullptr) runtime.ReleaseEnv(environment);
        }
        const ort::Runtime& runtime;
        ort::Object environment = nullptr, options = nullptr, session = nullptr, memory = nullptr;
    };

    std::string bytes_;
    ort::Runtime runtime_;
    Handles own_{runtime_};
};

std::unique_ptr<Model> open_model(const std::string& path, const std::string& key) {
    return std::make_unique<OnnxModel>(path, key);
}
