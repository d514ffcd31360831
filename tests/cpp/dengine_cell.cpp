// A cell's controller without Python: an exported file decides on traces from stdin.
//
//   dengine_cell model.ts < traces.csv                      one trace a line, samples separated by commas
//   dengine_cell model.ts --binary < traces.f32             blocks of little-endian float32, a trace each
//   dengine_cell model.ts --learn --journal cell.csv < labelled.csv    a line begins with its label: 1, 0 or nothing
//   dengine_cell model.ts --parts ...                       a line begins with its part's number, before any label
//
// Out, a line a trace: action,reason,lower,upper,n_success,n_failure,embedding...,microseconds
//
// --learn takes in, after the decision on a trace, what became of its part. Where that was to verify, the label is what was
// found. Where it was to accept, 0 is a stop, 1 a confirmation, and nothing is silence until the next decision, which
// counts as the file says. A rejected part went back to the bin, so its label is not read. Without --learn no silence
// counts. A line that cannot be read is answered with verify,malformed; the program goes on and ends with exit code 1. So
// does a model that must not be used.
#include <ATen/Parallel.h>
#include <c10/core/InferenceMode.h>

#include <chrono>
#include <cstdio>
#include <exception>
#include <iostream>
#include <limits>
#include <optional>
#include <string>

#include "journal.hpp"
#include "lines.hpp"
#include "model.hpp"

struct Options {
    std::string model, journal;
    bool binary = false, learn = false, parts = false;
};

static std::optional<Options> parse_options(int argc, char** argv) {
    Options options;
    for (int i = 1; i < argc; ++i) {
        const std::string word = argv[i];
        if (word == "--binary") {
            options.binary = true;
        } else if (word == "--learn") {
            options.learn = true;
        } else if (word == "--parts") {
            options.parts = true;
        } else if (word == "--journal" && i + 1 < argc) {
            options.journal = argv[++i];
        } else if (word.starts_with("--") || !options.model.empty()) {
            return std::nullopt;
        } else {
            options.model = word;
        }
    }
    const bool words = options.learn || options.parts;  // stand beside the samples in a line
    const bool consistent = !(words && options.binary) && (options.learn || options.journal.empty());
    return !options.model.empty() && consistent ? std::optional(options) : std::nullopt;
}

static void print(const std::string& action, const std::string& reason, const Decision& decision, double microseconds) {
    std::printf("%s,%s,%.17g,%.17g,%lld,%lld", action.c_str(), reason.c_str(), decision.lower, decision.upper,
                static_cast<long long>(decision.n_success), static_cast<long long>(decision.n_failure));
    for (const float z : decision.embedding) std::printf(",%.9g", z);
    std::printf(",%.3f\n", microseconds);
    std::fflush(stdout);  // the cell waits for this line
}

static int run(const Options& options) {
    at::set_num_threads(1);  // steadier by far at these sizes
    Model model(options.model);
    const c10::InferenceMode guard;

    std::optional<Journal> journal;
    if (!options.journal.empty()) journal.emplace(options.journal, model);
    const Decision unknown{0, 0, 0.0, 1.0, 0, 0, std::vector<float>(model.width, std::numeric_limits<float>::quiet_NaN())};
    int malformed = 0;
    Input input;
    const Columns columns{options.parts, options.learn};
    const auto next = [&] {
        return options.binary ? next_block(std::cin, model.shape.size(), input) : next_line(std::cin, columns, model.shape, input);
    };
    for (long long number = 1; next(); ++number) {
        if (!input.fault.empty()) {
            ++malformed;
            std::fprintf(stderr, "dengine_cell: trace %lld is malformed: %s\n", number, input.fault.c_str());
            print(model.actions[0], "malformed", unknown, 0.0);
            continue;
        }
        const auto begin = std::chrono::steady_clock::now();
        const Decision decision = model.decide(input.samples, input.part);
        const std::chrono::duration<double, std::micro> elapsed = std::chrono::steady_clock::now() - begin;
        print(model.actions.at(decision.action), model.reasons.at(decision.reason), decision, elapsed.count());
        if (!options.learn) {
            model.drop();
        } else if (decision.action == ACCEPT || (decision.action == VERIFY && input.success)) {
            if (journal) journal->append(input, decision);  // written before it is counted
            if (input.success) model.tell(input.samples, input.part, decision.action, *input.success);
        }
    }
    return malformed > 0 ? 1 : 0;
}

int main(int argc, char** argv) {
    std::ios::sync_with_stdio(false);
    const auto options = parse_options(argc, argv);
    if (!options) {
        std::fprintf(stderr, "usage: dengine_cell MODEL.ts [--binary | [--parts] [--learn [--journal FILE]]] < TRACES\n");
        return 2;
    }
    try {
        return run(*options);
    } catch (const c10::Error& error) {
        std::fprintf(stderr, "dengine_cell: %s: %s\n", options->model.c_str(), error.what_without_backtrace());
    } catch (const std::exception& error) {
        std::fprintf(stderr, "dengine_cell: %s: %s\n", options->model.c_str(), error.what());
    }
    return 1;
}
