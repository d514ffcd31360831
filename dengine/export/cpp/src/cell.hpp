// A cell: a model, what it decided on and still waits to hear of, and a journal where one is kept.
#pragma once

#include <cstdio>
#include <limits>
#include <deque>
#include <memory>
#include <optional>
#include <random>
#include <string>
#include <unordered_map>
#include <utility>
#include <vector>

#include "journal.hpp"
#include "model.hpp"

constexpr std::size_t REMEMBERED = 10'000;  // parts whose label may still come

class Cell {
  public:
    Cell(std::unique_ptr<Model> opened, const std::string& journal) : model(std::move(opened)), run_(new_run()) {
        if (journal.empty()) return;
        if (!model->learns) throw Fault(DENGINE_BAD_JOURNAL, "a model in ONNX learns nothing and keeps no journal");
        journal_.emplace(
            journal, *model, [this](Record&& record) { restore(std::move(record)); },
            [this](const std::string& id, bool success) { repeat(id, success); });
    }

    // The decision on a part, whose label may come: it is in the journal, and waits. Whatever fails in the model, the part
    // is verified.
    Decision decide(std::vector<float> samples, std::string part, std::string& id) {
        Record record;
        record.id = run_ + '-' + std::to_string(++count_);
        record.part = std::move(part);
        record.samples = std::move(samples);
        last_.clear();
        try {
            record.decision = model->decide(record.samples, record.part);
            record.predicted = model->predicted();
        } catch (const std::exception& error) {
            fault = first_line(error);
            record.decision = unknown("model_error");
        }
        const Decision decision = record.decision;
        if (!model->learns) return decision;
        try {
            if (journal_) journal_->part(record);
        } catch (const Fault&) {
            model->drop();  // no label could be kept, so none will come
            throw;
        }
        id = record.id;
        remember(std::move(record));
        return decision;
    }

    // What became of a part. Its label is on the disk when this returns; told twice, it counts once.
    void label(const std::string& id, bool success) {
        if (!model->learns) throw Fault(DENGINE_BAD_LABEL, "a model in ONNX learns nothing; export TorchScript");
        const auto found = parts_.find(id);
        if (found == parts_.end()) {
            throw Fault(DENGINE_BAD_LABEL, "expected the id of one of the last " + std::to_string(REMEMBERED) +
                                               " decisions, got \"" + id.substr(0, 40) + "\"");
        }
        Record& record = found->second;
        if (record.decision.action == REJECT) {
            throw Fault(DENGINE_BAD_LABEL, id + " was rejected; the part went back to the bin and has no label");
        }
        if (record.label == success) return;
        if (record.label) {
            throw Fault(DENGINE_BAD_LABEL, id + " has the other label already; correct it in the store, with dengine correct");
        }
        if (journal_) journal_->label(id, success);
        take(record, success);
    }

    void stop(const std::string& id) {
        const auto found = parts_.find(id);
        if (found != parts_.end() && found->second.decision.action == VERIFY) {
            throw Fault(DENGINE_BAD_LABEL, id + " was to be verified and cannot stop the system; say label ID 0");
        }
        label(id, false);
    }

    Decision unknown(const std::string& reason) const {
        Decision decision;
        decision.reason = reason;
        decision.embedding.assign(model->width, std::numeric_limits<float>::quiet_NaN());
        return decision;
    }

    const std::string& notice() const {
        static const std::string none;
        return journal_ ? journal_->notice : none;
    }

    std::unique_ptr<Model> model;
    std::string fault;  // of the model, when it failed last

  private:
    static std::string first_line(const std::exception& error) {
        const std::string text = error.what();
        return text.substr(0, text.find('\n'));
    }

    static std::string new_run() {
        std::random_device device;
        char text[16];
        std::snprintf(text, sizeof text, "%08x%04x", device(), device() & 0xffff);
        return text;
    }

    void remember(Record&& record) {
        std::string id = record.id;
        last_ = id;
        order_.push_back(id);
        parts_.insert_or_assign(std::move(id), std::move(record));
        for (; order_.size() > REMEMBERED; order_.pop_front()) parts_.erase(order_.front());
    }

    // A label on any part, by the bounds that it was decided by.
    void take(Record& record, bool success) {
        const bool accepted = record.decision.action == ACCEPT, is_last = record.id == last_;
        record.label = success;
        // Where all stops are reported, the next decision confirmed an accepted part: it is counted. A stop that comes
        // later is counted beside it, and makes the wrong confirmation good at the next export.
        const bool counted = accepted && model->stops_all && !is_last && success;
        if (!counted) {
            try {
                teach(record, success, is_last);
            } catch (const std::exception& error) {
                fault = first_line(error);  // the label is kept; the model goes on without it
            }
        }
        record.samples = {};
    }

    void teach(Record& record, bool success, bool is_last) {
        const auto action = record.decision.action;
        if (is_last) return model->tell(record.samples, record.part, action, success);
        // What waits steps aside and comes back: nothing has been heard of it yet.
        model->drop();
        if (action == ACCEPT && !model->stops_all) model->set_unreported(model->unreported() - 1);  // its outcome is known
        put_back(record);
        model->tell(record.samples, record.part, action, success);
        const auto last = parts_.find(last_);
        const bool waits = last != parts_.end() && !last->second.label && last->second.decision.action != REJECT;
        if (waits) put_back(last->second);
    }

    void put_back(Record& record) {
        const Decision& decision = record.decision;
        model->restore(record.samples, record.part, decision.action, decision.reason, decision.lower, decision.upper);
    }

    // A line of the journal.
    void restore(Record&& record) {
        try {
            if (record.decision.action == REJECT) {
                model->settle();
                model->drop();
            } else {
                put_back(record);
            }
        } catch (const std::exception& error) {
            fault = first_line(error);  // as it failed when it was decided on
            model->drop();
        }
        remember(std::move(record));
    }

    void repeat(const std::string& id, bool success) {
        const auto found = parts_.find(id);
        if (found != parts_.end() && !found->second.label) take(found->second, success);
    }

    std::optional<Journal> journal_;
    std::unordered_map<std::string, Record> parts_;
    std::deque<std::string> order_;  // their ids, oldest first
    std::string last_, run_;         // the part that was decided on last; what ids of this run begin with
    long long count_ = 0;
};
