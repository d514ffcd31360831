// An exported decision in TorchScript.
#include <ATen/Parallel.h>
#include <c10/core/InferenceMode.h>
#include <torch/script.h>

#include <sstream>

#include "files.hpp"
#include "model.hpp"

const char* const RUNTIME = "libtorch";
const char* const PROGRAM = "dengine-cell";

// What a model knows a part by: 64-bit FNV-1a (Fowler, Noll and Vo) of its number's bytes, as in Python. Never 0, which is
// a part of unknown number: that one is known by its trace.
static std::int64_t part_hash(std::string_view part) {
    if (part.empty()) return 0;
    std::uint64_t h = 0xCBF29CE484222325;
    for (const unsigned char byte : part) h = (h ^ byte) * 0x100000001B3;
    return h == 0 ? 1 : static_cast<std::int64_t>(h);
}

// Steadier by far at these sizes; each thread that calls has its own number.
static void on_one_thread() {
    static thread_local const bool once = (at::set_num_threads(1), true);
    (void)once;
}

class TorchModel final : public Model {
  public:
    TorchModel(const std::string& path, const std::string& key)
        : module_((on_one_thread(), load(path, key))), decide_(module_.get_method("decide")) {
        const Metadata metadata = description();
        read(metadata);
        check_golden(metadata);
    }

    Decision decide(std::vector<float>& x, const std::string& part) override {
        on_one_thread();
        return decide(decide_, x, part);
    }

    void tell(std::vector<float>& x, const std::string& part, std::int64_t action, bool success) override {
        const c10::InferenceMode guard;
        if (action == ACCEPT && !success) {
            module_.run_method("stop", tensor(x), part_hash(part));
        } else {
            module_.run_method("learn", tensor(x), success, part_hash(part));
        }
    }

    void drop() override { module_.run_method("drop"); }

    void settle() override {
        const c10::InferenceMode guard;
        module_.run_method("settle");
    }

    std::int64_t predicted() override { return module_.run_method("predicted").toInt(); }

    void restore(std::vector<float>& x, const std::string& part, std::int64_t action, const std::string& reason, double lower,
                 double upper) override {
        const c10::InferenceMode guard;
        module_.run_method("restore", tensor(x), part_hash(part), action, position(reasons, reason), lower, upper);
    }

    std::int64_t unreported() override { return module_.attr("n_unreported").toInt(); }

    void set_unreported(std::int64_t n) override { module_.setattr("n_unreported", n); }

  private:
    Decision decide(torch::jit::Method& method, std::vector<float>& x, const std::string& part) const {
        const c10::InferenceMode guard;
        const auto result = method({tensor(x), part_hash(part)});
        const auto& field = result.toTupleRef().elements();
        const at::Tensor z = field[6].toTensor().contiguous();
        const float* first = z.const_data_ptr<float>();
        const auto why = static_cast<std::size_t>(field[1].toInt());
        return {field[0].toInt(),   reasons.at(why),    field[2].toDouble(), field[3].toDouble(),
                field[4].toInt(), field[5].toInt(), {first, first + z.numel()}};
    }

    torch::jit::Module load(const std::string& path, const std::string& key) {
        std::istringstream stream(checked_bytes(path, key, sum));
        try {
            auto module = torch::jit::load(stream, torch::kCPU, extra_);
            module.eval();
            return module;
        } catch (const c10::Error& error) {
            const std::string why = error.what_without_backtrace();
            throw Fault(DENGINE_BAD_MODEL, "it has its checksum but is no loadable TorchScript: " + why);
        }
    }

    Metadata description() const {
        const auto& json = extra_.at("dengine.json");
        if (json.empty()) throw Fault(DENGINE_BAD_MODEL, "it is not a dengine export: it holds no dengine.json");
        return Metadata(json);
    }

    at::Tensor tensor(std::vector<float>& x) const {
        const auto channels = static_cast<std::int64_t>(shape.channels);
        return torch::from_blob(x.data(), {channels, static_cast<std::int64_t>(x.size()) / channels}, torch::kFloat32);
    }

    void check_golden(const Metadata& metadata) {
        std::vector<float> trace = floats(metadata.list("golden.trace"));
        const std::vector<float> expected = floats(metadata.list("golden.embedding"));
        if (trace.size() != shape.size() || expected.size() != width) {
            throw Fault(DENGINE_BAD_MODEL, "its golden trace does not fit its own TraceSpec");
        }
        const c10::InferenceMode guard;
        // A copy runs the same compiled code, and this module must not learn of the golden trace.
        torch::jit::Module copy = module_.deepcopy();
        torch::jit::Method method = copy.get_method("decide");
        for (int i = 0; i < WARM_UP; ++i) {
            must_agree(decide(method, trace, "").embedding, expected);
            copy.run_method("learn", tensor(trace), true, 0);
            copy.run_method("stop", tensor(trace), 0);
        }
    }

    torch::jit::ExtraFilesMap extra_{{"dengine.json", ""}};
    torch::jit::Module module_;
    torch::jit::Method decide_;
};

std::unique_ptr<Model> open_model(const std::string& path, const std::string& key) {
    try {
        return std::make_unique<TorchModel>(path, key);
    } catch (const c10::Error& error) {
        const std::string why = error.what_without_backtrace();
        throw Fault(DENGINE_BAD_MODEL, "it is not a dengine export, or not one for this program: " + why);
    }
}
