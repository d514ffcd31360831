// What goes wrong, with the number that the C interface returns for it.
#pragma once

#include <stdexcept>
#include <string>

#include "dengine.h"

struct Fault : std::runtime_error {
    Fault(int code, const std::string& text) : std::runtime_error(text), code(code) {}
    int code;
};
