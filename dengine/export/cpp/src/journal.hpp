// What became of parts, a line each, after a first line that names the export it belongs to:
//
//   # dengine 4 SUM
//   part,ID,LABEL,PART,ACTION,PREDICTED,REASON,LOWER,UPPER,N_SUCCESS,N_FAILURE,SAMPLE,SAMPLE,...,CRC
//   label,ID,LABEL,CRC
//
// LABEL is 1 or 0, and nothing in a `part` line, CRC the CRC-32 of the first line and of all lines up to here, each without
// its own CRC and the comma before it: a line that is missing, doubled or moved is noticed. A `part` line is there when a part was decided on; its label follows in a `label` line, however late. A rejected part has no samples: it went
// back to the bin. An accepted one without a label is not counted by its line: the next decision does, as confirmed where
// the file says that all stops are reported, as silent where it does not. So each line is there before it is counted, and a
// restarted cell that reads them again is where it was. `dengine import-labels` takes them into a store.
//
// A label is on the disk (fdatasync) when it is acknowledged; a decision is handed to the operating system, and reaches
// the disk with the next label. A last line without its end was being written when the process was killed: it was never
// acknowledged, and is cut off. Anything else that does not fit is damage, and is refused with its number.
//
// A small file beside it, PATH.head, has the number of its lines and the last CRC, so that lines which are missing at its end
// are noticed too. It is written after the line, in place: where the process is killed in between, it is a line behind.
#pragma once

#include <fcntl.h>
#include <sys/file.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <fstream>
#include <functional>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "crc32.hpp"
#include "fault.hpp"
#include "lines.hpp"
#include "model.hpp"

// A part that was decided on, and what became of it.
struct Record {
    std::string id, part;
    std::vector<float> samples;
    Decision decision;
    std::int64_t predicted = VERIFY;
    std::optional<bool> label;
};

class Journal {
  public:
    using OnPart = std::function<void(Record&&)>;
    using OnLabel = std::function<void(const std::string& id, bool success)>;

    // Every whole line that is there already is handed on, in order.
    Journal(const std::string& path, const Model& model, const OnPart& on_part, const OnLabel& on_label)
        : path_(path), model_(model) {
        file_ = ::open(path.c_str(), O_RDWR | O_APPEND | O_CREAT | O_CLOEXEC, 0644);
        if (file_ < 0) fail("cannot be opened: " + reason());
        try {
            if (::flock(file_, LOCK_EX | LOCK_NB) != 0) fail("is being written by another program");
            reread(on_part, on_label);
        } catch (...) {
            ::close(file_);
            throw;
        }
    }

    ~Journal() { ::close(file_); }
    Journal(const Journal&) = delete;
    Journal& operator=(const Journal&) = delete;

    // A part that was decided on last.
    void part(const Record& record) {
        const Decision& decision = record.decision;
        std::string line = "part," + record.id + ",," + record.part + ',';
        line += model_.actions.at(decision.action) + ',' + model_.actions.at(record.predicted) + ',' + decision.reason + ',' +
                written(decision.lower) + ',' + written(decision.upper) + ',' + written(decision.n_success) + ',' +
                written(decision.n_failure);
        if (decision.action != REJECT) {
            for (const float x : record.samples) line += ',' + written(x);
        }
        append(line, false);
    }

    void label(const std::string& id, bool success) { append("label," + id + (success ? ",1" : ",0"), true); }

    std::string notice;  // what was found that the user should know

  private:
    void reread(const OnPart& on_part, const OnLabel& on_label) {
        const std::string head = "# dengine 4 " + model_.sum;
        std::ifstream in(path_, std::ios::binary);
        std::string line;
        std::vector<std::uint32_t> lines;
        for (number_ = 1; std::getline(in, line); ++number_) {
            const bool cut = in.eof();  // the file ends before the line does
            // Labels that a newer export already holds must not be counted twice.
            if (number_ == 1 && line != head && !(cut && head.starts_with(line))) {
                fail("belongs to another export, release or program; take it in with its own dengine import-labels, and name "
                     "a new journal");
            }
            if (cut) break;
            if (number_ == 1) crc_ = crc32::onward(0, line);
            if (number_ > 1 && !take(line, on_part, on_label)) {
                fail("is damaged in line " + std::to_string(number_) + ", or a line before it is missing; take its earlier "
                     "lines in with dengine import-labels, and name a new journal");
            }
            size_ += static_cast<off_t>(line.size()) + 1;
            lines.push_back(crc_);
        }
        const off_t found = ::lseek(file_, 0, SEEK_END);
        if (found < size_) fail("cannot be read");
        if (found > size_) {
            notice = path_ + ": the last line was cut while it was written; its " + std::to_string(found - size_) +
                     " bytes were dropped, nothing in it had been acknowledged";
            if (::ftruncate(file_, size_) != 0) fail("cannot be shortened: " + reason());
        }
        if (size_ == 0) {
            write(head + '\n', true);
            crc_ = crc32::onward(0, head);
            number_ = 2;  // of the next line, as after reading one
        } else {
            compare(lines);
        }
        note();
    }

    // What the head knows of a journal whose lines have these CRCs.
    void compare(const std::vector<std::uint32_t>& lines) {
        std::ifstream in(path_ + ".head", std::ios::binary);
        long long known = 0;
        std::string crc;
        const std::string end = "; lines may have been removed at its end, or lost with the power";
        if (!(in >> known >> crc)) {
            add(path_ + ".head, which knows how long the journal is, is missing or cannot be read" + end);
        } else if (known < 1 || known > static_cast<long long>(lines.size()) ||
                   crc32::hex(lines[static_cast<std::size_t>(known - 1)]) != crc) {
            add(path_ + " does not hold line " + std::to_string(known) + ", which its head knows" + end);
        }
    }

    void add(const std::string& what) { notice += (notice.empty() ? "" : ". ") + what; }

    // The head: how many lines there are, and the CRC of all of them. It may not cost the cell a label.
    void note() {
        const std::string head = std::to_string(number_ - 1) + ' ' + crc32::hex(crc_);
        const int file = ::open((path_ + ".head").c_str(), O_WRONLY | O_CREAT | O_CLOEXEC, 0644);
        if (file < 0) return;
        const std::string text = head + std::string(31 - head.size(), ' ') + '\n';
        if (::pwrite(file, text.data(), text.size(), 0) < 0) errno = 0;
        ::close(file);
    }

    bool take(std::string_view line, const OnPart& on_part, const OnLabel& on_label) {
        const bool is_part = line.starts_with("part,");
        if (!is_part && !line.starts_with("label,")) return false;
        const auto comma = line.rfind(',');
        crc_ = crc32::onward(crc_, line.substr(0, comma));
        if (crc32::hex(crc_) != line.substr(comma + 1)) return false;
        line = line.substr(line.find(',') + 1, comma - line.find(',') - 1);
        if (is_part) return take_part(line, on_part);
        bool more = true;
        const std::string id(take_word(line, more)), label(take_word(line, more));
        if (more || (label != "1" && label != "0")) return false;
        on_label(id, label == "1");
        return true;
    }

    // The decision with its own numbers, of its own time.
    bool take_part(std::string_view line, const OnPart& on_part) {
        bool more = true;
        const auto word = [&] { return more ? take_word(line, more) : std::string_view(); };
        Record record;
        record.id = word();
        if (word() != "") return false;
        record.part = word();
        const auto action = position(model_.actions, word()), predicted = position(model_.actions, word());
        record.decision.reason = word();
        const bool numbers = parse(word(), record.decision.lower) && parse(word(), record.decision.upper) &&
                             parse(word(), record.decision.n_success) && parse(word(), record.decision.n_failure);
        if (!numbers || action < 0 || predicted < 0 || position(model_.reasons, record.decision.reason) < 0) return false;
        record.decision.action = action;
        record.predicted = predicted;
        if (action == REJECT && !more) {
            on_part(std::move(record));
            return true;
        }
        Input input;
        parse_line(line, model_.shape, input);
        if (!more || !input.fault.empty() || action == REJECT) return false;
        record.samples = std::move(input.samples);
        on_part(std::move(record));
        return true;
    }

    void append(const std::string& line, bool on_disk) {
        const auto crc = crc32::onward(crc_, line);
        write(line + ',' + crc32::hex(crc) + '\n', on_disk);
        crc_ = crc;
        ++number_;
        note();
    }

    // All of it, or nothing of it.
    void write(const std::string& text, bool on_disk) {
        if (broken_) fail("could not be written before; open it anew");
        std::size_t done = 0;
        while (done < text.size()) {
            const auto n = ::write(file_, text.data() + done, text.size() - done);
            if (n < 0 && errno == EINTR) continue;
            if (n <= 0) break;
            done += static_cast<std::size_t>(n);
        }
        if (done < text.size() || (on_disk && ::fdatasync(file_) != 0)) {
            const std::string why = reason();
            broken_ = ::ftruncate(file_, size_) != 0;
            fail("cannot be written: " + why);
        }
        size_ += static_cast<off_t>(text.size());
    }

    static std::string reason() { return std::strerror(errno); }

    [[noreturn]] void fail(const std::string& why) const { throw Fault(DENGINE_BAD_JOURNAL, "the journal " + path_ + " " + why); }

    std::string path_;
    const Model& model_;
    int file_ = -1;
    off_t size_ = 0;
    long long number_ = 0;
    std::uint32_t crc_ = 0;  // of all lines so far
    bool broken_ = false;
};
