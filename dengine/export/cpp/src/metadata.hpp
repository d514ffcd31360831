// What an exported file says of itself: JSON (RFC 8259), flattened to "trace.samples" -> "1000", "reasons.0" -> "certain".
#pragma once

#include <cctype>
#include <map>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "numbers.hpp"

class Metadata {
  public:
    explicit Metadata(std::string_view json) : rest_(json) {
        value("");
        skip_space();
        if (!rest_.empty()) fail("the end");
    }

    const std::string& text(const std::string& key) const {
        const auto found = scalars_.find(key);
        if (found == scalars_.end()) throw std::runtime_error("its description has no \"" + key + "\"");
        return found->second;
    }

    // The same, or what an earlier version meant, which did not say it.
    std::string text(const std::string& key, const std::string& otherwise) const {
        return scalars_.count(key) ? text(key) : otherwise;
    }

    double number(const std::string& key) const {
        double x = 0.0;
        if (!parse(text(key), x)) throw std::runtime_error("its description's \"" + key + "\" is no number");
        return x;
    }

    // Every scalar of a list, in order, lists within lists included.
    std::vector<std::string> list(const std::string& key) const {
        std::vector<std::string> out;
        for (int i = 0;; ++i) {
            const std::string item = key + "." + std::to_string(i);
            if (const auto found = scalars_.find(item); found != scalars_.end()) {
                out.push_back(found->second);
                continue;
            }
            const auto inner = lists_.count(item) ? list(item) : std::vector<std::string>{};
            if (inner.empty()) return out;
            out.insert(out.end(), inner.begin(), inner.end());
        }
    }

  private:
    void value(const std::string& path, int depth = 0) {
        if (depth > 32) fail("fewer levels");
        skip_space();
        const char first = rest_.empty() ? '\0' : rest_.front();
        if (first == '{') {
            members('}', [&](int) {
                skip_space();
                const std::string name = string();
                take(':');
                value(path.empty() ? name : path + "." + name, depth + 1);
            });
        } else if (first == '[') {
            lists_[path] = true;
            members(']', [&](int i) { value(path + "." + std::to_string(i), depth + 1); });
        } else {
            scalars_[path] = first == '"' ? string() : word();
        }
    }

    template <typename Member>
    void members(char close, Member member) {
        rest_.remove_prefix(1);
        skip_space();
        if (!rest_.empty() && rest_.front() == close) return rest_.remove_prefix(1);
        for (int i = 0;; ++i) {
            member(i);
            skip_space();
            if (rest_.empty() || (rest_.front() != ',' && rest_.front() != close)) fail("a comma or a bracket");
            const bool last = rest_.front() == close;
            rest_.remove_prefix(1);
            if (last) return;
        }
    }

    std::string string() {
        take('"');
        std::string out;
        while (!rest_.empty() && rest_.front() != '"') {
            if (rest_.front() == '\\' && rest_.size() > 1) {
                rest_.remove_prefix(1);
                const auto at = std::string_view("nrtbf").find(rest_.front());
                out += at == std::string_view::npos ? rest_.front() : "\n\r\t\b\f"[at];  // \uXXXX stays as uXXXX
            } else {
                out += rest_.front();
            }
            rest_.remove_prefix(1);
        }
        take('"');
        return out;
    }

    std::string word() {
        std::size_t n = 0;
        const auto belongs = [](unsigned char c) { return std::isalnum(c) || c == '+' || c == '-' || c == '.'; };
        while (n < rest_.size() && belongs(rest_[n])) ++n;
        if (n == 0) fail("a value");
        const std::string out(rest_.substr(0, n));
        rest_.remove_prefix(n);
        return out;
    }

    void take(char expected) {
        skip_space();
        if (rest_.empty() || rest_.front() != expected) fail(std::string(1, expected));
        rest_.remove_prefix(1);
    }

    void skip_space() {
        while (!rest_.empty() && std::isspace(static_cast<unsigned char>(rest_.front()))) rest_.remove_prefix(1);
    }

    [[noreturn]] void fail(const std::string& expected) const {
        const std::string near(rest_.substr(0, 12));
        throw std::runtime_error("its description is no JSON: expected " + expected + " before \"" + near + "\"");
    }

    std::string_view rest_;
    std::map<std::string, std::string> scalars_;
    std::map<std::string, bool> lists_;
};
