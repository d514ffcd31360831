// A model's file and what lies beside it: its sum and its signature are checked before anything is loaded.
#pragma once

#include <fstream>
#include <iterator>
#include <sstream>
#include <string>
#include <string_view>
#include <vector>

#include "fault.hpp"
#include "sha256.hpp"

constexpr std::size_t SHORTEST_KEY = 16;  // bytes

inline std::string read_file(const std::string& path, const std::string& advice) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw Fault(DENGINE_BAD_MODEL, "cannot read " + path + advice);
    return {std::istreambuf_iterator<char>(file), {}};
}

inline std::string name_of(const std::string& path) { return path.substr(path.find_last_of('/') + 1); }

// The first words of the lines that are about a file, or about none in particular. Two while a file is being replaced: the
// earlier one and the next. A file that was renamed together with its one line is still known by it.
inline std::vector<std::string> listed(const std::string& text, const std::string& name) {
    std::vector<std::string> found, others;
    std::istringstream lines(text);
    for (std::string line; std::getline(lines, line);) {
        while (!line.empty() && (line.back() == '\r' || line.back() == ' ')) line.pop_back();
        const auto space = line.find(' ');
        const std::string word = line.substr(0, space);
        if (word.empty()) continue;
        const auto begin = space == std::string::npos ? space : line.find_first_not_of(" *", space);
        const std::string about = begin == std::string::npos ? "" : line.substr(begin);
        (about.empty() || about == name ? found : others).push_back(word);
    }
    return found.empty() && others.size() == 1 ? others : found;
}

// The secret that a file was signed with: what the key's file holds, without the line end.
inline std::string read_key(const std::string& path) {
    std::string key = read_file(path, "; it is the key's file, as dengine export --make-key writes it");
    while (!key.empty() && (key.back() == '\n' || key.back() == '\r')) key.pop_back();
    if (key.size() < SHORTEST_KEY) throw Fault(DENGINE_BAD_MODEL, path + " is too short for a key; make one with dengine export --make-key");
    return key;
}

inline void check_signature(const std::string& path, const std::string& bytes, const std::string& key_path) {
    const std::string found = sha256::hmac(read_key(key_path), bytes);
    const std::string text = read_file(path + ".sig", "; a key was given, and the file is not signed: export it with --key");
    bool right = false;
    for (const auto& word : listed(text, name_of(path))) right |= sha256::same(word, "hmac-sha256:" + found);
    if (!right) throw Fault(DENGINE_BAD_MODEL, "its signature is not one by this key; it was changed, or signed with another key");
}

// A file's content and its sum. libtorch does not notice flipped bits, and runs whatever program a file holds.
inline std::string checked_bytes(const std::string& path, const std::string& key_path, std::string& sum) {
    const std::string bytes = read_file(path, "; an export is a file and its .sha256, copied together");
    if (!key_path.empty()) check_signature(path, bytes, key_path);
    const std::string text = read_file(path + ".sha256", "; an export is a file and its .sha256, copied together");
    sum = sha256::hex(bytes);
    bool any = false, right = false;
    for (const auto& word : listed(text, name_of(path))) {
        any |= word.size() == 64;
        right |= word == sum;
    }
    if (!any) throw Fault(DENGINE_BAD_MODEL, "its .sha256 holds no SHA-256 sum of it; copy it again");
    if (!right) throw Fault(DENGINE_BAD_MODEL, "it is damaged or truncated: its SHA-256 differs; copy it again");
    return bytes;
}
