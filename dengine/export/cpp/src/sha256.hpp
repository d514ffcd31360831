// SHA-256 of a block of bytes, and HMAC over it. Sources: FIPS 180-4, sections 4.1.2, 4.2.2, 5.1.1 and 6.2, and FIPS 198-1,
// section 4; names as there.
#pragma once

#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>

namespace sha256 {

inline constexpr std::array<std::uint32_t, 64> K = {
    0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
    0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
    0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
    0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
    0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
    0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
    0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
    0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};

using State = std::array<std::uint32_t, 8>;

inline void compress(State& H, const unsigned char* block) {
    std::array<std::uint32_t, 64> W;
    for (int t = 0; t < 16; ++t, block += 4) {
        W[t] = std::uint32_t{block[0]} << 24 | std::uint32_t{block[1]} << 16 | std::uint32_t{block[2]} << 8 | block[3];
    }
    for (int t = 16; t < 64; ++t) {
        const auto s0 = std::rotr(W[t - 15], 7) ^ std::rotr(W[t - 15], 18) ^ W[t - 15] >> 3;
        const auto s1 = std::rotr(W[t - 2], 17) ^ std::rotr(W[t - 2], 19) ^ W[t - 2] >> 10;
        W[t] = s1 + W[t - 7] + s0 + W[t - 16];
    }
    auto [a, b, c, d, e, f, g, h] = H;
    for (int t = 0; t < 64; ++t) {
        const auto S1 = std::rotr(e, 6) ^ std::rotr(e, 11) ^ std::rotr(e, 25);
        const auto T1 = h + S1 + ((e & f) ^ (~e & g)) + K[t] + W[t];
        const auto S0 = std::rotr(a, 2) ^ std::rotr(a, 13) ^ std::rotr(a, 22);
        const auto T2 = S0 + ((a & b) ^ (a & c) ^ (b & c));
        h = g, g = f, f = e, e = d + T1, d = c, c = b, b = a, a = T1 + T2;
    }
    const State working = {a, b, c, d, e, f, g, h};
    for (int i = 0; i < 8; ++i) H[i] += working[i];
}

// The sum, 32 bytes.
inline std::string digest(std::string_view bytes) {
    State H = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a, 0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
    const auto* data = reinterpret_cast<const unsigned char*>(bytes.data());
    const std::size_t whole = bytes.size() / 64 * 64;
    for (std::size_t i = 0; i < whole; i += 64) compress(H, data + i);

    std::string tail(bytes.substr(whole));  // 5.1.1: a one bit, zeros, the length in bits as 64 bits
    tail += '\x80';
    while (tail.size() % 64 != 56) tail += '\0';
    for (int shift = 56; shift >= 0; shift -= 8) tail += static_cast<char>(std::uint64_t{bytes.size()} * 8 >> shift & 0xff);
    for (std::size_t i = 0; i < tail.size(); i += 64) compress(H, reinterpret_cast<const unsigned char*>(tail.data()) + i);

    std::string out;
    for (const auto word : H) {
        for (int shift = 24; shift >= 0; shift -= 8) out += static_cast<char>(word >> shift & 0xff);
    }
    return out;
}

// Two lower-case hexadecimal digits a byte, as `sha256sum` prints them.
inline std::string in_hex(std::string_view bytes) {
    std::string out;
    for (const unsigned char byte : bytes) {
        out += "0123456789abcdef"[byte >> 4];
        out += "0123456789abcdef"[byte & 0xf];
    }
    return out;
}

inline std::string hex(std::string_view bytes) { return in_hex(digest(bytes)); }

// HMAC-SHA256 as 64 hexadecimal digits.
inline std::string hmac(std::string_view key, std::string_view text) {
    std::string K0 = key.size() > 64 ? digest(key) : std::string(key);
    K0.resize(64, '\0');
    std::string inner, outer;
    for (const char byte : K0) {
        inner += static_cast<char>(byte ^ 0x36);
        outer += static_cast<char>(byte ^ 0x5c);
    }
    return hex(outer + digest(inner.append(text)));
}

// Whether two texts are alike, in a time that does not tell where they differ.
inline bool same(std::string_view one, std::string_view other) {
    if (one.size() != other.size()) return false;
    unsigned char differences = 0;
    for (std::size_t i = 0; i < one.size(); ++i) differences |= static_cast<unsigned char>(one[i] ^ other[i]);
    return differences == 0;
}

}  // namespace sha256
