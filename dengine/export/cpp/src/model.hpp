// What a cell asks of an exported decision, whichever runtime computes it.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "fault.hpp"
#include "lines.hpp"
#include "metadata.hpp"

constexpr int SCHEMA = 2;
constexpr int WARM_UP = 3;  // the first calls compile
constexpr double TOLERANCE = 1e-4;

enum Action : std::int64_t { VERIFY, ACCEPT, REJECT };

struct Decision {
    std::int64_t action = VERIFY;
    std::string reason;
    double lower = 0.0, upper = 1.0;
    std::int64_t n_success = 0, n_failure = 0;
    std::vector<float> embedding;  // (K, d), row by row
};

class Model {
  public:
    virtual ~Model() = default;

    // x: channels * samples floats, channel by channel; read, not kept. Tells the model also that the next part has come:
    // an accepted one before it, of which nothing was heard, went on.
    virtual Decision decide(std::vector<float>& x, const std::string& part) = 0;

    // What became of the part that was decided last.
    virtual void tell(std::vector<float>& x, const std::string& part, std::int64_t action, bool success) = 0;

    // Nothing will be heard of the part that was decided last, and its silence says nothing.
    virtual void drop() = 0;

    // The next part has come, as `decide` says it.
    virtual void settle() = 0;

    // What the model alone would have done with the part that was decided last: audits are verified all the same.
    virtual std::int64_t predicted() = 0;

    // A decision that was made before, in the place of `decide`.
    virtual void restore(std::vector<float>& x, const std::string& part, std::int64_t action, const std::string& reason,
                         double lower, double upper) = 0;

    // Accepted parts since the last label of which nothing was heard.
    virtual std::int64_t unreported() = 0;
    virtual void set_unreported(std::int64_t n) = 0;

    Shape shape;
    std::vector<std::string> actions, reasons;
    std::size_t width = 0;  // numbers in an embedding
    std::string sum;
    bool stops_all = false;
    bool learns = true;

  protected:
    // What the file says of itself.
    void read(const Metadata& metadata) {
        if (const double schema = metadata.number("schema"); schema != SCHEMA) {
            const auto& version = metadata.text("dengine");
            throw Fault(DENGINE_BAD_MODEL, schema > SCHEMA
                ? "it was written by a newer dengine, " + version + "; build a newer cell program"
                : "it was written by an older dengine, " + version + "; export it anew");
        }
        shape.channels = static_cast<std::size_t>(metadata.number("trace.channels"));
        shape.samples = static_cast<std::size_t>(metadata.number("trace.samples"));
        shape.any_length = metadata.text("trace.fit", "strict") != "strict";
        actions = metadata.list("actions");
        reasons = metadata.list("reasons");
        width = static_cast<std::size_t>(metadata.number("spaces") * metadata.number("dim"));
        stops_all = metadata.text("stops", "some") == "all";
        if (shape.size() == 0 || width == 0 || actions.size() < 3) {
            throw Fault(DENGINE_BAD_MODEL, "its description has no trace, no embedding or no actions");
        }
    }

    static std::vector<float> floats(const std::vector<std::string>& words) {
        std::vector<float> out(words.size());
        for (std::size_t i = 0; i < words.size(); ++i) {
            if (!parse(words[i], out[i])) throw Fault(DENGINE_BAD_MODEL, "its golden trace is no row of numbers");
        }
        return out;
    }

    static void must_agree(const std::vector<float>& found, const std::vector<float>& expected) {
        for (std::size_t j = 0; j < expected.size(); ++j) {
            const double want = expected[j];
            if (!(std::abs(found.at(j) - want) <= TOLERANCE * (1.0 + std::abs(want)))) {
                throw Fault(DENGINE_BAD_MODEL, "this machine does not reproduce its golden embedding; export it anew here");
            }
        }
    }
};

// Where a name stands in a list, -1 where it does not.
inline std::int64_t position(const std::vector<std::string>& names, std::string_view name) {
    const auto found = std::find(names.begin(), names.end(), name);
    return found == names.end() ? -1 : found - names.begin();
}

// Checked, loaded, its golden trace reproduced. Each runtime has its own.
std::unique_ptr<Model> open_model(const std::string& path, const std::string& key);

// Which runtime that is, and the name of its program.
extern const char* const RUNTIME;
extern const char* const PROGRAM;
