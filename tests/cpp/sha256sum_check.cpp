// Prints the SHA-256 of stdin, so that a test can hold the header against another implementation.
#include <iostream>
#include <iterator>

#include "sha256.hpp"

int main() {
    std::cout << sha256::hex(std::string(std::istreambuf_iterator<char>(std::cin), {})) << '\n';
}
