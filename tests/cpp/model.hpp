// An exported decision: its sum checked before it is loaded, its own golden trace reproduced before it answers.
#pragma once

#include <torch/script.h>

#include <cmath>
#include <fstream>
#include <iterator>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "metadata.hpp"
#include "sha256.hpp"

constexpr int SCHEMA = 1;
constexpr int WARM_UP = 3;  // the first calls compile
constexpr double TOLERANCE = 1e-4;

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

class Model {
  public:
    explicit Model(const std::string& path)
        : module_(load(path)), metadata_(description()), decide_(module_.get_method("decide")) {
        if (metadata_.number("schema") > SCHEMA) {
            const auto& version = metadata_.text("dengine");
            throw std::runtime_error("it was written by a newer dengine, " + version + "; build a newer cell program");
        }
        channels = static_cast<std::int64_t>(metadata_.number("trace.channels"));
        samples = static_cast<std::int64_t>(metadata_.number("trace.samples"));
        actions = metadata_.list("actions");
        reasons = metadata_.list("reasons");
        width = static_cast<std::size_t>(metadata_.number("spaces") * metadata_.number("dim"));
        check_golden();
    }

    // x: channels * samples floats, channel by channel; read, not kept.
    Decision decide(float* x) {
        const auto result = decide_({tensor(x)});
        const auto& field = result.toTupleRef().elements();
        const at::Tensor z = field[6].toTensor().contiguous();
        const float* first = z.const_data_ptr<float>();
        return {field[0].toInt(), field[1].toInt(), field[2].toDouble(), field[3].toDouble(),
                field[4].toInt(), field[5].toInt(), {first, first + z.numel()}};
    }

    // Make a verified trace a reference; returns how many are held.
    std::int64_t learn(float* x, bool success) { return module_.run_method("learn", tensor(x), success).toInt(); }

    std::int64_t channels, samples;
    std::vector<std::string> actions, reasons;
    std::size_t width;  // numbers in an embedding
    std::string sum;

  private:
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

    at::Tensor tensor(float* x) const { return torch::from_blob(x, {channels, samples}, torch::kFloat32); }

    void check_golden() {
        std::vector<float> trace;
        for (const auto& word : metadata_.list("golden.trace")) trace.push_back(std::strtof(word.c_str(), nullptr));
        const auto expected = metadata_.list("golden.embedding");
        if (trace.size() != static_cast<std::size_t>(channels * samples) || expected.size() != width) {
            throw std::runtime_error("its golden trace does not fit its own contract");
        }
        for (int i = 0; i < WARM_UP; ++i) {
            const auto found = decide(trace.data()).embedding;
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
