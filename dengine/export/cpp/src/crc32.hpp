// CRC-32 of a block of bytes, as zlib's crc32 and IEEE 802.3 have it: it finds a line of a journal that
// was cut or changed, and, run on from line to line, one that is missing or moved.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <string_view>

namespace crc32 {

inline constexpr std::array<std::uint32_t, 256> TABLE = [] {
    std::array<std::uint32_t, 256> table{};
    for (std::uint32_t i = 0; i < 256; ++i) {
        std::uint32_t c = i;
        for (int bit = 0; bit < 8; ++bit) c = c & 1 ? 0xEDB88320 ^ c >> 1 : c >> 1;
        table[i] = c;
    }
    return table;
}();

// Of what stands before, and these bytes behind it; 0 before the first.
inline std::uint32_t onward(std::uint32_t before, std::string_view bytes) {
    std::uint32_t c = ~before;
    for (const unsigned char byte : bytes) c = TABLE[(c ^ byte) & 0xff] ^ c >> 8;
    return ~c;
}

// Eight lower-case hexadecimal digits.
inline std::string hex(std::uint32_t c) {
    std::string out;
    for (int shift = 28; shift >= 0; shift -= 4) out += "0123456789abcdef"[c >> shift & 0xf];
    return out;
}

}  // namespace crc32
