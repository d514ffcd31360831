// What became of parts, one line each, after a first line that names the export it belongs to:
//
//   label,part,action,predicted,reason,lower,upper,n_success,n_failure,sample,sample,...
//
// An accepted part has its line whether its label is known or not. One without a label is not counted by that line: the
// next decision does, as confirmed where the file says that all stops are reported, as silent where it does not. So each
// line is there before it is counted, and a restarted cell that reads them again is where it was. `dengine import-labels`
// takes them into a store. A line is handed to the operating system before the next trace is read: it survives a killed
// process, not a lost power supply.
#pragma once

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

#include "lines.hpp"
#include "model.hpp"

class Journal {
  public:
    // The model takes in every line that is there already.
    Journal(const std::string& path, Model& model) : path_(path), model_(model) {
        const std::string head = "# dengine 2 " + model.sum;
        const bool fresh = !reread(head);
        file_ = std::fopen(path.c_str(), "a");
        if (file_ == nullptr) throw std::runtime_error("cannot write the journal " + path);
        if (fresh) write(head + "\n");
    }

    ~Journal() { std::fclose(file_); }
    Journal(const Journal&) = delete;
    Journal& operator=(const Journal&) = delete;

    // The part that was decided on last.
    void append(const Input& input, const Decision& decision) {
        char words[128];
        std::snprintf(words, sizeof words, ",%.17g,%.17g,%lld,%lld", decision.lower, decision.upper,
                      static_cast<long long>(decision.n_success), static_cast<long long>(decision.n_failure));
        std::string line = input.success ? (*input.success ? "1," : "0,") : ",";
        line += input.part + ',' + model_.actions.at(decision.action) + ',' + model_.actions.at(model_.predicted()) + ',' +
                model_.reasons.at(decision.reason) + words;
        for (const float x : input.samples) line.append(words, std::snprintf(words, sizeof words, ",%.9g", x));
        write(line + "\n");
    }

  private:
    bool reread(const std::string& head) {
        std::ifstream in(path_);
        std::string line;
        if (!std::getline(in, line)) return false;
        // Labels that a newer export already holds must not be counted twice.
        if (line != head) {
            throw std::runtime_error(path_ + " belongs to another export, or to an older program; "
                                             "take it in with dengine import-labels, and name a new journal");
        }
        while (std::getline(in, line)) {
            const bool cut = in.eof();  // no line end: the process was killed while it wrote
            if (cut || !relearn(line)) throw std::runtime_error(path_ + " has a line that was not finished; remove it");
        }
        return true;
    }

    // The decision with its own numbers, of its own time, and its label.
    bool relearn(std::string_view line) {
        bool more = true;
        const auto word = [&] { return std::string(more ? take_word(line, more) : std::string_view()); };
        const std::string label = word(), part = word(), action = word(), predicted = word(), reason = word();
        const std::string lower = word(), upper = word(), n_success = word(), n_failure = word();
        Input input;
        parse_line(line, {}, model_.shape, input);
        const auto did = position(model_.actions, action), why = position(model_.reasons, reason);
        if (!more || !input.fault.empty() || did < 0 || why < 0 || label.size() > 1) return false;
        model_.restore(input.samples, part, did, why, std::strtod(lower.c_str(), nullptr),
                       std::strtod(upper.c_str(), nullptr));
        if (label != "") model_.tell(input.samples, part, did, label == "1");
        return true;
    }

    static std::int64_t position(const std::vector<std::string>& names, const std::string& name) {
        const auto found = std::find(names.begin(), names.end(), name);
        return found == names.end() ? -1 : found - names.begin();
    }

    void write(const std::string& text) {
        if (std::fwrite(text.data(), 1, text.size(), file_) != text.size() || std::fflush(file_) != 0) {
            throw std::runtime_error("cannot write the journal " + path_);
        }
    }

    std::string path_;
    Model& model_;
    std::FILE* file_ = nullptr;
};
