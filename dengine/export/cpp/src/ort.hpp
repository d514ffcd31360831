// The few functions of onnxruntime's C interface that a decision needs, from the shared library at run time.
//
// onnxruntime's packages for Python bring the library without its header. The interface is made for that: a program asks
// OrtGetApiBase for the table of version 2 of the interface, and the order of the functions in it never changes (upstream
// asserts it when it compiles; its binding for C# repeats the table, too). So only positions are written down here. Where
// onnxruntime_c_api.h is found, the compiler holds every one against it.
#pragma once

#include <dlfcn.h>

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "fault.hpp"

#if __has_include(<onnxruntime_c_api.h>)
#include <onnxruntime_c_api.h>
#define ORT_POSITION(name, at) static_assert(offsetof(OrtApi, name) == at * sizeof(void*));
#else
#define ORT_POSITION(name, at)
#endif

namespace ort {

constexpr std::uint32_t VERSION = 2;
constexpr int ERROR_WARNING = 2, FLOAT = 1, INT64 = 7, DOUBLE = 11, ARENA = 1, DEFAULT_MEMORY = 0;

// A pointer to something of onnxruntime's own; which one, its place in a call says.
using Object = void*;
using Status = void*;

class Runtime {
  public:
    explicit Runtime(const std::vector<std::string>& names) {
        std::string tried;
        for (const auto& name : names) {
            if (void* library = dlopen(name.c_str(), RTLD_NOW | RTLD_LOCAL)) {
                take(library, name);
                return;
            }
            tried += std::string(tried.empty() ? "" : "; ") + dlerror();
        }
        throw Fault(DENGINE_FAILED, "onnxruntime's library was not found; name it in DENGINE_ONNXRUNTIME: " + tried);
    }

#define ORT_FUNCTION(at, result, name, ...)                                                        \
    template <typename... Given>                                                                   \
    result name(Given... given) const {                                                            \
        ORT_POSITION(name, at)                                                                     \
        return reinterpret_cast<result (*)(__VA_ARGS__)>(const_cast<void*>(table_[at]))(given...); \
    }
    ORT_FUNCTION(2, const char*, GetErrorMessage, Status)
    ORT_FUNCTION(3, Status, CreateEnv, int, const char*, Object*)
    ORT_FUNCTION(8, Status, CreateSessionFromArray, Object, const void*, std::size_t, Object, Object*)
    ORT_FUNCTION(9, Status, Run, Object, Object, const char* const*, const Object*, std::size_t, const char* const*, std::size_t, Object*)
    ORT_FUNCTION(10, Status, CreateSessionOptions, Object*)
    ORT_FUNCTION(22, Status, SetSessionLogSeverityLevel, Object, int)
    ORT_FUNCTION(24, Status, SetIntraOpNumThreads, Object, int)
    ORT_FUNCTION(25, Status, SetInterOpNumThreads, Object, int)
    ORT_FUNCTION(49, Status, CreateTensorWithDataAsOrtValue, Object, void*, std::size_t, const std::int64_t*, std::size_t, int, Object*)
    ORT_FUNCTION(51, Status, GetTensorMutableData, Object, void**)
    ORT_FUNCTION(60, Status, GetTensorElementType, Object, int*)
    ORT_FUNCTION(64, Status, GetTensorShapeElementCount, Object, std::size_t*)
    ORT_FUNCTION(65, Status, GetTensorTypeAndShape, Object, Object*)
    ORT_FUNCTION(69, Status, CreateCpuMemoryInfo, int, int, Object*)
    ORT_FUNCTION(78, Status, GetAllocatorWithDefaultOptions, Object*)
    ORT_FUNCTION(92, void, ReleaseEnv, Object)
    ORT_FUNCTION(93, void, ReleaseStatus, Status)
    ORT_FUNCTION(94, void, ReleaseMemoryInfo, Object)
    ORT_FUNCTION(95, void, ReleaseSession, Object)
    ORT_FUNCTION(96, void, ReleaseValue, Object)
    ORT_FUNCTION(99, void, ReleaseTensorTypeAndShapeInfo, Object)
    ORT_FUNCTION(100, void, ReleaseSessionOptions, Object)
    ORT_FUNCTION(111, Status, SessionGetModelMetadata, Object, Object*)
    ORT_FUNCTION(116, Status, ModelMetadataLookupCustomMetadataMap, Object, Object, const char*, char**)
    ORT_FUNCTION(118, void, ReleaseModelMetadata, Object)
#undef ORT_FUNCTION

    // Throws what a call had to say.
    void check(Status status, int code = DENGINE_FAILED) const {
        if (status == nullptr) return;
        const std::string text = GetErrorMessage(status);
        ReleaseStatus(status);
        throw Fault(code, text.substr(0, text.find('\n')));
    }

  private:
    struct Base {
        const void* const* (*GetApi)(std::uint32_t version);
        const char* (*GetVersionString)();
    };

    void take(void* library, const std::string& name) {
        const auto base = reinterpret_cast<const Base* (*)()>(dlsym(library, "OrtGetApiBase"));
        table_ = base == nullptr ? nullptr : base()->GetApi(VERSION);
        if (table_ == nullptr) throw Fault(DENGINE_FAILED, name + " is no onnxruntime, or one without version 2 of its interface");
    }

    const void* const* table_ = nullptr;
};

}  // namespace ort
