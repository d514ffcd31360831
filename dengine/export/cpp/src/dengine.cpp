// The C interface: each function is a guard around one call, so that no exception leaves it.
#include "dengine.h"

#include <algorithm>
#include <cstring>
#include <mutex>
#include <new>

#include "cell.hpp"

struct dengine_cell {
    dengine_cell(const char* path, const char* key, const char* journal)
        : cell(open_model(path, key == nullptr ? "" : key), journal == nullptr ? "" : journal) {}

    Cell cell;
    std::mutex mutex;
    std::vector<float> embedding;
};

static thread_local std::string last_error;

template <typename Call>
static int guarded(Call call) noexcept {
    try {
        last_error.clear();
        call();
        return DENGINE_OK;
    } catch (const Fault& fault) {
        last_error = fault.what();
        return fault.code;
    } catch (const std::exception& error) {
        last_error = error.what();
    } catch (...) {
        last_error = "an unknown failure";
    }
    return DENGINE_FAILED;
}

static void expect(bool right, const char* text) {
    if (!right) throw Fault(DENGINE_BAD_CALL, text);
}

template <std::size_t N>
static void copy(char (&out)[N], const std::string& text) {
    const std::size_t n = std::min(text.size(), N - 1);
    std::memcpy(out, text.data(), n);
    out[n] = '\0';
}

static void fill(dengine_decision& out, const Decision& decision, const std::string& id) {
    out.action = static_cast<std::int32_t>(decision.action);
    copy(out.reason, decision.reason);
    out.lower = decision.lower;
    out.upper = decision.upper;
    out.n_success = decision.n_success;
    out.n_failure = decision.n_failure;
    copy(out.id, id);
}

static void fill_safe(dengine_decision& out) {
    Decision decision;
    decision.reason = "not_decided";
    fill(out, decision, "");
}

const char* dengine_version(void) { return DENGINE_VERSION; }

const char* dengine_error(void) { return last_error.c_str(); }

int dengine_open(const char* model, const char* key, const char* journal, dengine_cell** cell) {
    return guarded([&] {
        expect(cell != nullptr, "expected a place for the cell, got NULL");
        *cell = nullptr;
        expect(model != nullptr, "expected the path of a model, got NULL");
        *cell = new dengine_cell(model, key, journal);
    });
}

void dengine_close(dengine_cell* cell) { delete cell; }

const char* dengine_notice(const dengine_cell* cell) { return cell == nullptr ? "" : cell->cell.notice().c_str(); }

size_t dengine_channels(const dengine_cell* cell) { return cell == nullptr ? 0 : cell->cell.model->shape.channels; }

size_t dengine_samples(const dengine_cell* cell) { return cell == nullptr ? 0 : cell->cell.model->shape.samples; }

size_t dengine_width(const dengine_cell* cell) { return cell == nullptr ? 0 : cell->cell.model->width; }

int dengine_decide(dengine_cell* cell, const float* trace, size_t n, const char* part, dengine_decision* out) {
    if (out != nullptr) fill_safe(*out);
    return guarded([&] {
        expect(cell != nullptr && trace != nullptr && out != nullptr, "expected a cell, a trace and a place for the decision");
        const std::lock_guard lock(cell->mutex);
        const Shape& shape = cell->cell.model->shape;
        if (!shape.takes(n)) {
            throw Fault(DENGINE_BAD_CALL,
                        "expected " + std::to_string(shape.size()) + " samples, got " + std::to_string(n));
        }
        const std::string number = part == nullptr ? "" : part;
        expect(is_part(number), "expected a part's number without commas, line ends and blanks around it");
        std::string id;
        cell->cell.fault.clear();
        const Decision decision = cell->cell.decide({trace, trace + n}, number, id);
        cell->embedding = decision.embedding;
        fill(*out, decision, id);
        if (!cell->cell.fault.empty()) throw Fault(DENGINE_FAILED, cell->cell.fault);
    });
}

int dengine_decide_many(dengine_cell* cell, const float* traces, size_t count, size_t n, const char* const* parts,
                        dengine_decision* out) {
    int first = DENGINE_OK;
    std::string said;
    for (size_t i = 0; i < count; ++i) {
        const float* trace = traces == nullptr ? nullptr : traces + i * n;
        const int code = dengine_decide(cell, trace, n, parts == nullptr ? nullptr : parts[i], out == nullptr ? nullptr : out + i);
        if (code == DENGINE_OK || first != DENGINE_OK) continue;
        first = code;
        said = last_error;
    }
    last_error = said;
    return first;
}

int dengine_embedding(dengine_cell* cell, float* out, size_t n) {
    return guarded([&] {
        expect(cell != nullptr && out != nullptr, "expected a cell and a place for the embedding");
        const std::lock_guard lock(cell->mutex);
        expect(n == cell->embedding.size(), "expected room for dengine_width numbers, after a decision");
        std::copy(cell->embedding.begin(), cell->embedding.end(), out);
    });
}

int dengine_label(dengine_cell* cell, const char* id, int success) {
    return guarded([&] {
        expect(cell != nullptr && id != nullptr, "expected a cell and the id of a decision");
        expect(success == 0 || success == 1, "expected a label of 0 or 1");
        const std::lock_guard lock(cell->mutex);
        cell->cell.label(id, success == 1);
    });
}

int dengine_stop(dengine_cell* cell, const char* id) {
    return guarded([&] {
        expect(cell != nullptr && id != nullptr, "expected a cell and the id of a decision");
        const std::lock_guard lock(cell->mutex);
        cell->cell.stop(id);
    });
}
