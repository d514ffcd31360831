// An exported decision: its sum checked before it is loaded, its own golden trace reproduced before it answers.
#pragma once

#include <torch/script.h>

#include <cmath>
#include <cstdint>
#include <fstream>
#include <iterator>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

#include "lines.hpp"
#include "metadata.hpp"
#include "sha256.hpp"

constexpr int SCHEMA = 2;
constexpr int WARM_UP = 3;  // the first calls compile
constexpr double TOLERANCE = 1e-4;

enum Action : std::int64_t { VERIFY, ACCEPT, REJECT };

struct Decision {
    std::int64_t action, reason;
    double lower, upper;
    std::int64_t n_success, n_failure;
    std::vector<float> embedding;  // (K, d), row by row
};

inline std::string read_file(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw std::runtime_error("cannot read " + path + "; an export is a file and its .sha256, copied together");
    return {std::istreambuf_iterator<char>(file), {}};
}

// libtorch does not notice flipped bits, so nothing is loaded before its sum is right.
inline std::string checked_bytes(const std::string& path, std::string& sum) {
    const std::string bytes = read_file(path);
    std::istringstream(read_file(path + ".sha256")) >> sum;
    if (sum.size() != 64) throw std::runtime_error("its .sha256 holds no SHA-256 sum; copy it again");
    if (sha256::hex(bytes) != sum) {
        throw std::runtime_error("it is damaged or truncated: its SHA-256 differs; copy it again");
    }
    return bytes;
}

// What a model knows a part by: 64-bit FNV-1a (Fowler, Noll and Vo) of its number's bytes, as in Python. Never 0, which is
// a part of unknown number: that one is known by its trace.
inline std::int64_t part_hash(std::string_view part) {
    if (part.empty()) return 0;
    std::uint64_t h = 0xCBF29CE484222325;
    for (const unsigned char byte : part) h = (h ^ byte) * 0x100000001B3;
    return h == 0 ? 1 : static_cast<std::int64_t>(h);
}

class Model {
  public:
    explicit Model(const std::string& path)
        : module_(load(path)), metadata_(description()), decide_(module_.get_method("decide")) {
        if (const double schema = metadata_.number("schema"); schema != SCHEMA) {
            const auto& version = metadata_.text("dengine");
            throw std::runtime_error(schema > SCHEMA
                ? "it was written by a newer dengine, " + version + "; build a newer cell program"
                : "it was written by an older dengine, " + version + "; export it anew");
        }
        shape.channels = static_cast<std::size_t>(metadata_.number("trace.channels"));
        shape.samples = static_cast<std::size_t>(metadata_.number("trace.samples"));
        shape.any_length = metadata_.text("trace.fit", "strict") != "strict";
        actions = metadata_.list("actions");
        reasons = metadata_.list("reasons");
        width = static_cast<std::size_t>(metadata_.number("spaces") * metadata_.number("dim"));
        check_golden();
    }

    // x: channels * samples floats, channel by channel; read, not kept. Another length is fitted by the model. Tells the model also that the next part has come:
    // an accepted one before it, of which nothing was heard, went on.
    Decision decide(std::vector<float>& x, const std::string& part) { return decide(decide_, x, part); }

    // What became of the part that was decided last.
    void tell(std::vector<float>& x, const std::string& part, std::int64_t action, bool success) {
        if (action == ACCEPT && !success) {
            module_.run_method("stop", tensor(x), part_hash(part));
        } else {
            module_.run_method("learn", tensor(x), success, part_hash(part));
        }
    }

    // Nothing will be heard of the part that was decided last, and its silence says nothing.
    void drop() { module_.run_method("drop"); }

    // What the model alone would have done with the part that was decided last: audits are verified all the same.
    std::int64_t predicted() { return module_.run_method("predicted").toInt(); }

    // A decision of an earlier run, in the place of `decide`.
    void restore(std::vector<float>& x, const std::string& part, std::int64_t action, std::int64_t reason, double lower, double upper) {
        module_.run_method("restore", tensor(x), part_hash(part), action, reason, lower, upper);
    }

    Shape shape;
    std::vector<std::string> actions, reasons;
    std::size_t width;  // numbers in an embedding
    std::string sum;

  private:
    Decision decide(torch::jit::Method& method, std::vector<float>& x, const std::string& part) const {
        const auto result = method({tensor(x), part_hash(part)});
        const auto& field = result.toTupleRef().elements();
        const at::Tensor z = field[6].toTensor().contiguous();
        const float* first = z.const_data_ptr<float>();
        return {field[0].toInt(), field[1].toInt(), field[2].toDouble(), field[3].toDouble(),
                field[4].toInt(), field[5].toInt(), {first, first + z.numel()}};
    }

    torch::jit::Module load(const std::string& path) {
        std::istringstream stream(checked_bytes(path, sum));
        try {
            auto module = torch::jit::load(stream, torch::kCPU, extra_);
            module.eval();
            return module;
        } catch (const c10::Error& error) {
            const std::string why = error.what_without_backtrace();
            throw std::runtime_error("it has its checksum but is no loadable TorchScript: " + why);
        }
    }

    Metadata description() const {
        const auto& json = extra_.at("dengine.json");
        if (json.empty()) throw std::runtime_error("it is not a dengine export: it holds no dengine.json");
        return Metadata(json);
    }

    at::Tensor tensor(std::vector<float>& x) const {
        const auto channels = static_cast<std::int64_t>(shape.channels);
        return torch::from_blob(x.data(), {channels, static_cast<std::int64_t>(x.size()) / channels}, torch::kFloat32);
    }

    void check_golden() {
        std::vector<float> trace;
        for (const auto& word : metadata_.list("golden.trace")) trace.push_back(std::strtof(word.c_str(), nullptr));
        const auto expected = metadata_.list("golden.embedding");
        if (trace.size() != shape.size() || expected.size() != width) {
            throw std::runtime_error("its golden trace does not fit its own contract");
        }
        // A copy runs the same compiled code, and this module must not learn of the golden trace.
        torch::jit::Module copy = module_.deepcopy();
        torch::jit::Method method = copy.get_method("decide");
        for (int i = 0; i < WARM_UP; ++i) {
            const auto found = decide(method, trace, "").embedding;
            copy.run_method("learn", tensor(trace), true, 0);
            copy.run_method("stop", tensor(trace), 0);
            for (std::size_t j = 0; j < width; ++j) {
                const double want = std::strtod(expected[j].c_str(), nullptr);
                if (!(std::abs(found.at(j) - want) <= TOLERANCE * (1.0 + std::abs(want)))) {
                    throw std::runtime_error("this machine does not reproduce its golden embedding; export it anew here");
                }
            }
        }
    }

    torch::jit::ExtraFilesMap extra_{{"dengine.json", ""}};
    torch::jit::Module module_;
    Metadata metadata_;
    torch::jit::Method decide_;
};
