// Prints the SHA-256 of stdin, or with a key its HMAC, so that a test can hold the header against another implementation.
#include <iostream>
#include <iterator>

#include "sha256.hpp"

int main(int argc, char** argv) {
    const std::string text(std::istreambuf_iterator<char>(std::cin), {});
    std::cout << (argc > 1 ? sha256::hmac(argv[1], text) : sha256::hex(text)) << '\n';
}
