// A cell's controller without Python: an exported file decides, line by line, from stdin to stdout.
//
//   dengine-cell model.ts [--key FILE] [--journal cell.csv]
//
//   decide [PART] TRACE    ->  ID,action,reason,lower,upper,n_success,n_failure,embedding...,microseconds
//   label ID 0|1           ->  ok ID          what became of the part, however late; 0 of an accepted one is a stop
//   stop ID                ->  ok ID          an accepted part was bad and stopped the system
//
// TRACE is numbers with commas between, or a file: NAME.f32 of little-endian float32, any other of numbers as text. What
// cannot be done is answered with `error WHY`, a trace that cannot be read with verify,malformed; the program goes on and
// ends with exit code 1. So does a model that must not be used. `ok` means: on the disk, where there is a journal.
#include <chrono>
#include <csignal>
#include <cstdio>
#include <exception>
#include <iostream>
#include <optional>
#include <sstream>
#include <string>
#include <vector>

#include "cell.hpp"
#include "lines.hpp"

constexpr std::streamoff LARGEST = 64 << 20;  // bytes of a trace's file

struct Options {
    std::string model, journal, key;
};

static std::optional<Options> parse_options(int argc, char** argv) {
    Options options;
    for (int i = 1; i < argc; ++i) {
        const std::string word = argv[i];
        if (word == "--journal" && i + 1 < argc) {
            options.journal = argv[++i];
        } else if (word == "--key" && i + 1 < argc) {
            options.key = argv[++i];
        } else if (word.starts_with("--") || !options.model.empty()) {
            return std::nullopt;
        } else {
            options.model = word;
        }
    }
    return options.model.empty() ? std::nullopt : std::optional(options);
}

static void say(const std::string& line) {
    std::printf("%s\n", line.c_str());
    std::fflush(stdout);  // the cell waits for this line
}

static void print(const std::string& id, const std::string& action, const Decision& decision, double microseconds) {
    std::string line = (id.empty() ? "-" : id) + ',' + action + ',' + decision.reason + ',' + written(decision.lower) + ',' +
                       written(decision.upper) + ',' + written(decision.n_success) + ',' + written(decision.n_failure);
    for (const float z : decision.embedding) line += ',' + written(z);
    say(line + ',' + written(microseconds));
}

// Answers each line, and counts those that it could not.
class Answers {
  public:
    explicit Answers(Cell& cell) : cell_(cell), model_(*cell.model) {}

    void answer(const std::string& line) {
        ++number_;
        const std::vector<std::string> words = split(line);
        if (words.empty()) return;
        try {
            if (words[0] == "decide") {
                decide(words);
            } else if (words[0] == "label") {
                if (words.size() != 3 || (words[2] != "0" && words[2] != "1")) throw Fault(DENGINE_BAD_CALL, "expected label ID 0|1");
                cell_.label(words[1], words[2] == "1");
                say("ok " + words[1]);
            } else if (words[0] == "stop") {
                if (words.size() != 2) throw Fault(DENGINE_BAD_CALL, "expected stop ID");
                cell_.stop(words[1]);
                say("ok " + words[1]);
            } else {
                throw Fault(DENGINE_BAD_CALL, "expected decide, label or stop, got " + quoted(words[0]));
            }
        } catch (const std::exception& error) {
            ++refused;
            say(std::string("error ") + error.what());
        }
        if (cell_.fault.empty()) return;
        std::fprintf(stderr, "dengine: line %lld: the model failed: %s\n", number_, cell_.fault.c_str());
        cell_.fault.clear();
    }

    int refused = 0;

  private:
    static std::vector<std::string> split(const std::string& line) {
        std::istringstream in(line);
        std::vector<std::string> words;
        for (std::string word; in >> word;) words.push_back(word);
        return words;
    }

    void decide(const std::vector<std::string>& words) {
        Input input;
        if (words.size() < 2 || words.size() > 3) {
            input.fault = "expected decide [PART] TRACE, a part's number and a file's name without blanks";
        } else {
            read(words.back(), input);
            if (words.size() == 3) input.part = words[1];
            if (!is_part(input.part)) input.fault = "expected a part's number in UTF-8, without commas";
        }
        if (!input.fault.empty()) return refuse(input.fault, "malformed");
        const auto begin = std::chrono::steady_clock::now();
        try {
            std::string id;
            const Decision decision = cell_.decide(std::move(input.samples), input.part, id);
            const std::chrono::duration<double, std::micro> elapsed = std::chrono::steady_clock::now() - begin;
            print(id, model_.actions.at(decision.action), decision, elapsed.count());
        } catch (const Fault& fault) {
            refuse(fault.what(), "journal_error");  // no label of it could be kept: it is verified
        }
    }

    void refuse(const std::string& why, const std::string& reason) {
        ++refused;
        std::fprintf(stderr, "dengine: trace %lld is %s: %s\n", number_, reason.c_str(), why.c_str());
        print("", model_.actions[0], cell_.unknown(reason), 0.0);
    }

    void read(const std::string& word, Input& input) {
        float number = 0.0F;
        if (word.find(',') != std::string::npos || parse(word, number)) return parse_line(word, model_.shape, input);
        std::ifstream file(word, std::ios::binary | std::ios::ate);
        const std::streamoff size = file ? static_cast<std::streamoff>(file.tellg()) : -1;
        if (size < 0 || size > LARGEST) {
            input.fault = "cannot read " + word + ", or it is no trace's file";
            return;
        }
        file.seekg(0);
        std::string text(static_cast<std::size_t>(size), '\0');
        if (!file.read(text.data(), size)) input.fault = "cannot read " + word;
        if (!input.fault.empty()) return;
        if (word.ends_with(".f32")) return take_floats(text, input);
        std::string numbers;  // one line of it
        for (const auto& each : split(text)) numbers += (numbers.empty() || numbers.back() == ',' ? "" : ",") + each;
        while (!numbers.empty() && numbers.back() == ',') numbers.pop_back();
        parse_line(numbers, model_.shape, input);
    }

    void take_floats(const std::string& bytes, Input& input) {
        input.samples.resize(bytes.size() / sizeof(float));
        std::copy_n(bytes.data(), input.samples.size() * sizeof(float), reinterpret_cast<char*>(input.samples.data()));
        if (bytes.size() % sizeof(float) == 0 && model_.shape.takes(input.samples.size())) return;
        const auto expected = std::to_string(model_.shape.size() * sizeof(float));
        input.fault = "expected " + expected + " bytes, got " + std::to_string(bytes.size());
    }

    Cell& cell_;
    Model& model_;
    long long number_ = 0;  // of the line
};

static int run(const Options& options) {
    Cell cell(open_model(options.model, options.key), options.journal);
    if (!cell.notice().empty()) std::fprintf(stderr, "dengine: %s\n", cell.notice().c_str());
    Answers answers(cell);
    for (std::string line; std::getline(std::cin, line);) answers.answer(line);
    return answers.refused > 0 ? 1 : 0;
}

int main(int argc, char** argv) {
    std::ios::sync_with_stdio(false);
    std::signal(SIGXFSZ, SIG_IGN);  // a journal that may not grow is an error that is answered, not the end of the program
    const auto options = parse_options(argc, argv);
    if (!options) {
        std::fprintf(stderr,
                     "usage: %s MODEL [--key FILE] [--journal FILE] < LINES\n"
                     "  decide [PART] TRACE | label ID 0|1 | stop ID\n", PROGRAM);
        return 2;
    }
    try {
        return run(*options);
    } catch (const std::exception& error) {
        std::fprintf(stderr, "%s: %s: %s\n", PROGRAM, options->model.c_str(), error.what());
    }
    return 1;
}
