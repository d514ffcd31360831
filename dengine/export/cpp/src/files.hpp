// A model's file and what lies beside it: its sum and its signature are checked before anything is loaded.
#pragma once

#include <fstream>
#include <iterator>
#include <sstream>
#include <string>

#include "fault.hpp"
#include "sha256.hpp"

constexpr std::size_t SHORTEST_KEY = 16;  // bytes

inline std::string read_file(const std::string& path, const std::string& advice) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw Fault(DENGINE_BAD_MODEL, "cannot read " + path + advice);
    return {std::istreambuf_iterator<char>(file), {}};
}

// Of the line of a sum or a signature; the file's name follows it.
inline std::string first_word(const std::string& text) {
    std::string word;
    std::istringstream(text) >> word;
    return word;
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
    if (!sha256::same(first_word(text), "hmac-sha256:" + found)) {
        throw Fault(DENGINE_BAD_MODEL, "its signature is not one by this key; it was changed, or signed with another key");
    }
}

// A file's content and its sum. libtorch does not notice flipped bits, and runs whatever program a file holds.
inline std::string checked_bytes(const std::string& path, const std::string& key_path, std::string& sum) {
    const std::string bytes = read_file(path, "; an export is a file and its .sha256, copied together");
    if (!key_path.empty()) check_signature(path, bytes, key_path);
    const std::string word = first_word(read_file(path + ".sha256", "; an export is a file and its .sha256, copied together"));
    sum = sha256::hex(bytes);
    if (word.size() != 64) throw Fault(DENGINE_BAD_MODEL, "its .sha256 holds no SHA-256 sum of it; copy it again");
    if (word != sum) throw Fault(DENGINE_BAD_MODEL, "it is damaged or truncated: its SHA-256 differs; copy it again");
    return bytes;
}
