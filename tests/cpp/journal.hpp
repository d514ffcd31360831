// What was learned, one line a trace, `label,sample,sample,...`, after a first line that names the export it belongs to.
// A restarted cell learns it again; `dengine import-labels` takes it into a store. Each line is handed to the operating
// system before the next trace is read: it survives a killed process, not a lost power supply.
#pragma once

#include <cstdio>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "lines.hpp"

class Journal {
  public:
    // Calls `learn(Input)` for every line that is there already.
    template <typename Learn>
    Journal(const std::string& path, const std::string& sum, std::size_t samples, Learn learn) : path_(path) {
        const std::string head = "# dengine " + sum;
        const bool fresh = !reread(head, samples, learn);
        file_ = std::fopen(path.c_str(), "a");
        if (file_ == nullptr) throw std::runtime_error("cannot write the journal " + path);
        if (fresh) write(head + "\n");
    }

    ~Journal() { std::fclose(file_); }
    Journal(const Journal&) = delete;
    Journal& operator=(const Journal&) = delete;

    void append(bool success, const std::vector<float>& samples) {
        std::string line(success ? "1" : "0");
        char word[32];
        for (const float x : samples) line.append(word, std::snprintf(word, sizeof word, ",%.9g", x));
        write(line + "\n");
    }

  private:
    template <typename Learn>
    bool reread(const std::string& head, std::size_t samples, Learn learn) {
        std::ifstream in(path_);
        std::string line;
        if (!std::getline(in, line)) return false;
        // Labels that a newer export already holds must not be counted twice.
        if (line != head) throw std::runtime_error(path_ + " belongs to another export; import it and name a new journal");
        Input input;
        while (std::getline(in, line)) {
            const bool cut = in.eof();  // no line end: the process was killed while it wrote
            parse_line(line, true, samples, input);
            if (cut || !input.fault.empty() || !input.success) {
                throw std::runtime_error(path_ + " has a line that was not finished; remove it");
            }
            learn(input);
        }
        return true;
    }

    void write(const std::string& text) {
        if (std::fwrite(text.data(), 1, text.size(), file_) != text.size() || std::fflush(file_) != 0) {
            throw std::runtime_error("cannot write the journal " + path_);
        }
    }

    std::string path_;
    std::FILE* file_ = nullptr;
};
