/* The decision of an exported dengine model, for a controller without Python.
 *
 *     dengine_cell *cell = NULL;
 *     if (dengine_open("model.ts", NULL, "cell.csv", &cell) != DENGINE_OK) { puts(dengine_error()); return 1; }
 *     dengine_decision said;
 *     dengine_decide(cell, samples, 1000, "P-17", &said);       what to do is in said.action, VERIFY after any fault
 *     if (said.action == DENGINE_VERIFY) dengine_label(cell, said.id, height_is_right());
 *     dengine_close(cell);
 *
 * An untrusted model is a program: loading it runs what is in it. Give a key, or load only files that you made.
 *
 * Threads: every call but dengine_close may come from any thread; calls on one cell wait for each other. The order of the
 * calls counts: a decision also says that the part before it went on. dengine_close must be the last call on its cell.
 * Each thread has an own dengine_error. Opening a model of libtorch sets the number of libtorch's threads to one, for the
 * whole process.
 *
 * No exception leaves a function, and no function keeps a pointer that it was given.
 */
#ifndef DENGINE_H
#define DENGINE_H

#include <stddef.h>
#include <stdint.h>

#if defined(__GNUC__)
#define DENGINE_API __attribute__((visibility("default")))
#else
#define DENGINE_API
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* What a function returns. */
enum {
    DENGINE_OK = 0,
    DENGINE_BAD_CALL = 1, /* an argument is missing, or a trace has another length: nothing was changed */
    DENGINE_BAD_MODEL = 2, /* the file must not be used: its sum, its signature, its description, its golden trace */
    DENGINE_BAD_JOURNAL = 3, /* the journal cannot be read or written; a label was not taken in */
    DENGINE_BAD_LABEL = 4, /* an unknown id, a rejected part, or another label than before */
    DENGINE_FAILED = 5 /* the model failed; the decision is VERIFY */
};

/* What to do with a part. Zero is the safe one. */
enum { DENGINE_VERIFY = 0, DENGINE_ACCEPT = 1, DENGINE_REJECT = 2 };

typedef struct dengine_cell dengine_cell;

typedef struct dengine_decision {
    int32_t action;
    char reason[24]; /* certain, uncertain, audit, novel, not_finite, ... */
    double lower, upper; /* the bounds of the probability of success */
    int64_t n_success, n_failure; /* the neighbours that were counted */
    char id[40]; /* names the decision when its label comes; "" where none can come */
} dengine_decision;

/* The version of this library, "0.5.0". */
DENGINE_API const char *dengine_version(void);

/* What the last call of this thread that did not return DENGINE_OK has to say. Valid until the thread's next call. */
DENGINE_API const char *dengine_error(void);

/* Check a model's file and load it.
 *
 * key : the file of the key that it was exported with, or NULL: then no signature is asked for.
 * journal : a file that keeps what becomes of parts, or NULL. One that is there is read again, and the cell goes on where
 *     it was. Without one, labels are learned and lost at the end. A model that cannot learn takes none. */
DENGINE_API int dengine_open(const char *model, const char *key, const char *journal, dengine_cell **cell);

/* Let a cell go; NULL is none. */
DENGINE_API void dengine_close(dengine_cell *cell);

/* What was found in the journal that the user should know, such as a last line that was cut; "" where it is nothing. */
DENGINE_API const char *dengine_notice(const dengine_cell *cell);

/* The trace that the model expects: channels x samples numbers, one channel after the other; and the numbers of an
 * embedding. */
DENGINE_API size_t dengine_channels(const dengine_cell *cell);
DENGINE_API size_t dengine_samples(const dengine_cell *cell);
DENGINE_API size_t dengine_width(const dengine_cell *cell);

/* Decide on one trace of n numbers, of the part with this number, NULL or "" where it is not known.
 *
 * `out` is always filled where it is given: after any fault it says VERIFY, with all bounds open. */
DENGINE_API int dengine_decide(dengine_cell *cell, const float *trace, size_t n, const char *part, dengine_decision *out);

/* The same for `count` traces of n numbers each, in order; `parts` and its members may be NULL. Returns the first fault. */
DENGINE_API int dengine_decide_many(dengine_cell *cell, const float *traces, size_t count, size_t n,
                                    const char *const *parts, dengine_decision *out);

/* The embedding of the part that was decided last, dengine_width numbers. */
DENGINE_API int dengine_embedding(dengine_cell *cell, float *out, size_t n);

/* What became of a part: 1 it was good, 0 it was not, which of an accepted part is a stop. As late as it comes; the same
 * label twice is one. When this returns DENGINE_OK the label is on the disk. */
DENGINE_API int dengine_label(dengine_cell *cell, const char *id, int success);

/* An accepted part was bad and stopped the system. */
DENGINE_API int dengine_stop(dengine_cell *cell, const char *id);

#ifdef __cplusplus
}
#endif
#endif
