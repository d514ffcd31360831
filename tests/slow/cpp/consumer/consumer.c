/* Decides on a file of float32 traces by the installed library, tells what became of them, and tries what is wrong.
 *
 *     consumer model.ts traces.f32 KEY|- JOURNAL|-      a line a trace: id action reason lower upper n_success n_failure
 */
#include <dengine.h>

#include <locale.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static dengine_cell *cell;
static float *traces;
static size_t samples, count;

static const char *or_null(const char *word) { return strcmp(word, "-") == 0 ? NULL : word; }

static int expect(int code, int expected, const char *call) {
    if (code == expected) return 0;
    fprintf(stderr, "%s returned %d, expected %d: %s\n", call, code, expected, dengine_error());
    return 1;
}

static void *decide_often(void *failed) {
    dengine_decision said;
    for (size_t i = 0; i < 50; ++i) {
        if (dengine_decide(cell, traces + i % count * samples, samples, NULL, &said) != DENGINE_OK) *(int *)failed = 1;
    }
    return NULL;
}

static int wrong_calls(const char *model) {
    dengine_decision said;
    dengine_cell *other = NULL;
    int wrong = 0;
    memset(&said, 1, sizeof said);
    wrong += expect(dengine_decide(cell, traces, samples - 1, NULL, &said), DENGINE_BAD_CALL, "a short trace");
    wrong += said.action != DENGINE_VERIFY || said.lower != 0.0 || said.upper != 1.0 || said.id[0] != '\0';
    wrong += strstr(dengine_error(), "samples, got") == NULL;
    memset(&said, 1, sizeof said);
    wrong += expect(dengine_decide(NULL, traces, samples, NULL, &said), DENGINE_BAD_CALL, "no cell");
    wrong += said.action != DENGINE_VERIFY;
    wrong += expect(dengine_decide(cell, NULL, samples, NULL, &said), DENGINE_BAD_CALL, "no trace");
    wrong += expect(dengine_decide(cell, traces, samples, NULL, NULL), DENGINE_BAD_CALL, "no place");
    wrong += expect(dengine_decide(cell, traces, samples, "P,1", &said), DENGINE_BAD_CALL, "a comma in a part's number");
    wrong += expect(dengine_label(cell, "nobody", 1), DENGINE_BAD_LABEL, "an unknown id");
    wrong += expect(dengine_label(cell, "nobody", 100), DENGINE_BAD_CALL, "a label of 100");
    wrong += expect(dengine_label(cell, NULL, 1), DENGINE_BAD_CALL, "no id");
    wrong += expect(dengine_stop(NULL, "x"), DENGINE_BAD_CALL, "a stop without a cell");
    wrong += expect(dengine_open("nowhere.ts", NULL, NULL, &other), DENGINE_BAD_MODEL, "a missing model");
    wrong += expect(dengine_open(model, "nowhere.key", NULL, &other), DENGINE_BAD_MODEL, "a missing key");
    wrong += expect(dengine_open(model, NULL, "/nowhere/at/all", &other), DENGINE_BAD_JOURNAL, "a journal that cannot be");
    wrong += expect(dengine_open(NULL, NULL, NULL, &other), DENGINE_BAD_CALL, "no model");
    wrong += expect(dengine_open(model, NULL, NULL, NULL), DENGINE_BAD_CALL, "no place for the cell");
    wrong += other != NULL;
    dengine_close(NULL);
    return wrong;
}

int main(int argc, char **argv) {
    if (argc != 5) return 2;
    setlocale(LC_ALL, ""); /* where a comma divides a number's decimals, the model is read all the same */
    if (dengine_open(argv[1], or_null(argv[3]), or_null(argv[4]), &cell) != DENGINE_OK) {
        fprintf(stderr, "%s\n", dengine_error());
        return 1;
    }
    samples = dengine_channels(cell) * dengine_samples(cell);
    FILE *file = fopen(argv[2], "rb");
    traces = malloc(1 << 24);
    count = fread(traces, sizeof(float) * samples, (1 << 24) / (sizeof(float) * samples), file);
    fclose(file);

    dengine_decision *said = calloc(count, sizeof *said);
    float *embedding = malloc(dengine_width(cell) * sizeof *embedding);
    int wrong = expect(dengine_decide_many(cell, traces, count, samples, NULL, said), DENGINE_OK, "dengine_decide_many");
    wrong += expect(dengine_embedding(cell, embedding, dengine_width(cell)), DENGINE_OK, "dengine_embedding");
    for (size_t i = 0; i < count; ++i) {
        printf("%s %d %s %ld %ld\n", said[i].id, said[i].action, said[i].reason, (long)said[i].n_success, (long)said[i].n_failure);
        const int stops = said[i].action == DENGINE_ACCEPT && i % 10 == 0;
        if (stops) wrong += expect(dengine_stop(cell, said[i].id), DENGINE_OK, "dengine_stop");
        if (said[i].action == DENGINE_VERIFY) wrong += expect(dengine_label(cell, said[i].id, 1), DENGINE_OK, "dengine_label");
        if (said[i].action == DENGINE_REJECT) wrong += expect(dengine_label(cell, said[i].id, 1), DENGINE_BAD_LABEL, "a reject");
    }
    wrong += wrong_calls(argv[1]);

    int failed = 0;
    pthread_t threads[4];
    for (int k = 0; k < 4; ++k) pthread_create(threads + k, NULL, decide_often, &failed);
    for (int k = 0; k < 4; ++k) pthread_join(threads[k], NULL);
    wrong += failed;
    printf("%s %zu %d%s\n", dengine_version(), count, wrong, dengine_notice(cell));
    dengine_close(cell);
    free(embedding);
    free(said);
    free(traces);
    return wrong != 0;
}
