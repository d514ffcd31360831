// Traces in: numbers with commas between. Several channels follow one another.
#pragma once

#include <bit>
#include <cstddef>
#include <string>
#include <string_view>
#include <vector>

#include "numbers.hpp"

static_assert(std::endian::native == std::endian::little, "binary traces are little-endian");

struct Input {
    std::string part;  // its number; empty where it is unknown
    std::vector<float> samples;
    std::string fault;  // why the line cannot be read; empty where it can
};

inline std::string_view trimmed(std::string_view word) {
    const auto first = word.find_first_not_of(" \t\r");
    if (first == std::string_view::npos) return {};
    return word.substr(first, word.find_last_not_of(" \t\r") - first + 1);
}

// Whether bytes are UTF-8, as far as a reader in another language asks (RFC 3629).
inline bool is_utf8(std::string_view text) {
    for (std::size_t i = 0; i < text.size();) {
        const unsigned char first = text[i++];
        const int more = first < 0x80 ? 0 : first >= 0xC2 && first < 0xE0 ? 1 : first >= 0xE0 && first < 0xF0 ? 2
                         : first >= 0xF0 && first < 0xF5 ? 3 : -1;
        if (more < 0) return false;
        for (int k = 0; k < more; ++k, ++i) {
            if (i == text.size() || (static_cast<unsigned char>(text[i]) & 0xC0) != 0x80) return false;
            const unsigned char byte = text[i];
            if (k == 0 && ((first == 0xE0 && byte < 0xA0) || (first == 0xED && byte > 0x9F))) return false;
            if (k == 0 && ((first == 0xF0 && byte < 0x90) || (first == 0xF4 && byte > 0x8F))) return false;
        }
    }
    return true;
}

// Whether a part's number can stand in a line: text without commas, control characters and blanks around it.
inline bool is_part(std::string_view part) {
    for (const unsigned char byte : part) {
        if (byte < 0x20 || byte == 0x7F || byte == ',') return false;
    }
    return trimmed(part) == part && is_utf8(part);
}

// The word before the next comma, which is taken off; `more` says whether there was one.
inline std::string_view take_word(std::string_view& line, bool& more) {
    const auto comma = line.find(',');
    const auto word = trimmed(line.substr(0, comma));
    more = comma != std::string_view::npos;
    line.remove_prefix(more ? comma + 1 : line.size());
    return word;
}

inline std::string quoted(std::string_view word) { return '"' + std::string(word.substr(0, 20)) + '"'; }

// How many samples a trace has: so many, or where the model fits other lengths, any number in each channel.
struct Shape {
    std::size_t channels = 1, samples = 0;
    bool any_length = false;

    std::size_t size() const { return channels * samples; }
    bool takes(std::size_t n) const { return n == size() || (any_length && n > 0 && n % channels == 0); }
};

// `sample,sample,...`
inline void parse_line(std::string_view line, const Shape& shape, Input& input) {
    input = {};
    bool more = true;
    while (more) {
        const auto word = take_word(line, more);
        float value = 0.0F;
        if (parse(word, value)) {
            input.samples.push_back(value);
        } else if (input.fault.empty()) {
            const auto column = std::to_string(1 + input.samples.size());
            input.fault = "expected a number in column " + column + ", got " + quoted(word);
        }
    }
    if (input.fault.empty() && !shape.takes(input.samples.size())) {
        input.fault = "expected " + std::to_string(shape.size()) + " samples, got " + std::to_string(input.samples.size());
    }
}
