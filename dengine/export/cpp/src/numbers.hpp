// Numbers from text and into it, whatever locale the program around this library has set.
#pragma once

#include <charconv>
#include <cstdint>
#include <limits>
#include <string>
#include <string_view>

inline bool parse(std::string_view word, double& out) {
    const auto [end, error] = std::from_chars(word.data(), word.data() + word.size(), out);
    if (error == std::errc::result_out_of_range && end == word.data() + word.size()) {
        const bool tiny = word.find("e-") != std::string_view::npos || word.find("E-") != std::string_view::npos;
        out = tiny ? 0.0 : std::numeric_limits<double>::infinity();
        if (word.front() == '-') out = -out;
        return true;
    }
    return error == std::errc() && end == word.data() + word.size();
}

// nan and inf are numbers here: a sensor that says so gets its reason from the model.
inline bool parse(std::string_view word, float& out) {
    const auto [end, error] = std::from_chars(word.data(), word.data() + word.size(), out);
    if (error == std::errc() && end == word.data() + word.size()) return true;
    double wide = 0.0;  // beyond a float's range: an infinity, or next to zero
    if (error != std::errc::result_out_of_range || !parse(word, wide)) return false;
    out = static_cast<float>(wide);
    return true;
}

inline bool parse(std::string_view word, std::int64_t& out) {
    const auto [end, error] = std::from_chars(word.data(), word.data() + word.size(), out);
    return error == std::errc() && end == word.data() + word.size();
}

// The shortest text that reads back as the same number.
template <typename Number>
std::string written(Number x) {
    char word[64];
    return {word, std::to_chars(word, word + sizeof word, x).ptr};
}
