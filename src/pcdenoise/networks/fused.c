/* The projection network's inference, point by point: a point's edges never leave the first cache.

   The same arithmetic as networks/projection.py and exchange.py, which say what it means; this is only where nobody learns.
   Not here: neighbour search, blocks, threads. Everything is float32 but positions and covariances, which are float64.
   Arrays are dense and row by row; weights of a layer come as (inputs, outputs), then its bias. */

#include <Python.h>

#include "../cloud/geometry.h"
#include "channels.h"

#define POINT_FEATURES 4
#define KERNEL_SHARE 0.7f

typedef struct {
    const double *points, *sources; /* (M, 3), (N, 3) */
    const int32_t *index;           /* (M, k): rows of each point's sources */
    const float *count;             /* (N,), or none */
    const float *noise;             /* (M,) */
    int k;
} Surroundings;

typedef struct {
    int k;
    float scale;                                               /* in the points' unit; everything else is in units of it */
    float x[MOST_NEIGHBOURS], y[MOST_NEIGHBOURS], z[MOST_NEIGHBOURS];  /* source minus point */
    float weight[MOST_NEIGHBOURS];                             /* of sum one */
} Neighbourhood;

typedef struct { /* a layer's weights lie input by input */
    const float *edge, *edge_bias, *own, *message, *message_bias, *update, *update_bias, *norm_gain, *norm_bias;
} Round;

typedef struct { float weight[POINT_FEATURES][CHANNELS], bias[CHANNELS]; } Embedding;

/* The weights of a round of messages of some width: moves on to the next round's. */
INLINE Round next_round(const float **weights, const int width) {
    const float *at = *weights;
    Round round;
    round.edge = at, at += EDGE_FEATURES * width;
    round.edge_bias = at, at += width;
    round.own = at, at += CHANNELS * width;
    round.message = at, at += width * width;
    round.message_bias = at, at += width;
    round.update = at, at += 2 * width * CHANNELS;
    round.update_bias = at, at += CHANNELS;
    round.norm_gain = at, at += CHANNELS;
    round.norm_bias = at, at += CHANNELS;
    *weights = at;
    return round;
}

/* exp(-x) for 0 <= x <= 1 / KERNEL_SHARE² to float32's rounding, without a call, so that a loop of it runs in lanes. */
INLINE float falling_exponential(float x) {
    const float t = x * -0.25f;
    const float root = 1 + t * (1 + t * (1 / 2.f + t * (1 / 6.f + t * (1 / 24.f + t * (1 / 120.f + t * (1 / 720.f + t / 5040))))));
    return (root * root) * (root * root);
}

INLINE void neighbourhood(Neighbourhood *near, const Surroundings *around, int64_t i) {
    const double *point = around->points + 3 * i, *sources = around->sources;
    const int32_t *index = around->index + i * around->k;
    const float *count = around->count;
    const int k = near->k = around->k;
    for (int j = 0; j < k; j++) {
        const double *source = sources + 3 * (size_t)index[j];
        near->x[j] = (float)(source[0] - point[0]);
        near->y[j] = (float)(source[1] - point[1]);
        near->z[j] = (float)(source[2] - point[2]);
    }
    float furthest = 0;
    for (int j = 0; j < k; j++)
        furthest = larger(furthest, near->x[j] * near->x[j] + near->y[j] * near->y[j] + near->z[j] * near->z[j]);
    near->scale = KERNEL_SHARE * larger(sqrtf(furthest), 1e-12f);
    const float unit = 1 / near->scale;
    float sum = 0;
    for (int j = 0; j < k; j++) {
        near->x[j] *= unit, near->y[j] *= unit, near->z[j] *= unit;
        const float squared = near->x[j] * near->x[j] + near->y[j] * near->y[j] + near->z[j] * near->z[j];
        const float falling = larger(1 - KERNEL_SHARE * KERNEL_SHARE * squared, 0);
        near->weight[j] = falling_exponential(squared) * falling * falling * (count ? count[index[j]] : 1);
        sum += near->weight[j];
    }
    for (int j = 0; j < k; j++) near->weight[j] /= larger(sum, 1e-12f);
}

INLINE void plane(const Neighbourhood *near, float *normal, float *shape) {
    double mean[3] = {0, 0, 0}, matrix[3][3], eigenvalues[3], vector[3];
    double xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0;
    for (int j = 0; j < near->k; j++) {
        const double w = near->weight[j];
        mean[0] += w * near->x[j], mean[1] += w * near->y[j], mean[2] += w * near->z[j];
    }
    for (int j = 0; j < near->k; j++) {
        const double w = near->weight[j], x = near->x[j] - mean[0], y = near->y[j] - mean[1], z = near->z[j] - mean[2];
        xx += w * x * x, xy += w * x * y, xz += w * x * z, yy += w * y * y, yz += w * y * z, zz += w * z * z;
    }
    matrix[0][0] = xx, matrix[1][1] = yy, matrix[2][2] = zz;
    matrix[0][1] = matrix[1][0] = xy, matrix[0][2] = matrix[2][0] = xz, matrix[1][2] = matrix[2][1] = yz;
    smallest_eigenvector(matrix, eigenvalues, vector);
    for (int i = 0; i < 3; i++) {
        normal[i] = (float)vector[i];
        shape[i] = near->scale * (float)sqrt(larger64(eigenvalues[i], 0));
    }
}

/* Planes and first features of the points in rows [start, stop). */
static ANY_PROCESSOR void look(const Surroundings *around, int64_t start, int64_t stop, const Embedding *embedding,
                               float *normals, float *shapes, float *features) {
    Neighbourhood near;
    for (int64_t i = start; i < stop; i++) {
        float *shape = shapes + 3 * i;
        neighbourhood(&near, around, i);
        plane(&near, normals + 3 * i, shape);
        if (!embedding) continue;
        const float thin = shape[0] / near.scale, middle = shape[1] / near.scale, wide = shape[2] / near.scale;
        const float level = around->noise[i] / near.scale;
        const float known[POINT_FEATURES] = {2 * thin, 2 * (wide - middle), 4 * level / (1 + level), thin / (thin + level + 1e-6f)};
        store(features + CHANNELS * i, layer(load(embedding->bias, CHANNELS), known, POINT_FEATURES, embedding->weight[0], CHANNELS),
              CHANNELS);
    }
}

typedef struct {
    float feature[MOST_NEIGHBOURS][EDGE_FEATURES];
    float a[MOST_NEIGHBOURS], b[MOST_NEIGHBOURS];  /* height over my plane, height of the neighbour's plane over me */
    float nx[MOST_NEIGHBOURS], ny[MOST_NEIGHBOURS], nz[MOST_NEIGHBOURS];
} Edges;

INLINE void edges(Edges *edge, const Neighbourhood *near, const float *own, const float *theirs, const int32_t *index, float noise) {
    const float level = noise / near->scale + 0.02f;
    for (int j = 0; j < near->k; j++) {
        const float *normal = theirs + 3 * (size_t)index[j];
        edge->nx[j] = normal[0], edge->ny[j] = normal[1], edge->nz[j] = normal[2];
    }
    for (int j = 0; j < near->k; j++) {
        const float x = near->x[j], y = near->y[j], z = near->z[j];
        const float a = x * own[0] + y * own[1] + z * own[2];
        const float b = x * edge->nx[j] + y * edge->ny[j] + z * edge->nz[j];
        const float cosine = edge->nx[j] * own[0] + edge->ny[j] * own[1] + edge->nz[j] * own[2];
        const float high = fabsf(a), deep = fabsf(b);
        float *feature = edge->feature[j];
        feature[0] = sqrtf(larger(x * x + y * y + z * z, 1e-24f));
        feature[1] = 4 * high;
        feature[2] = 4 * deep;
        feature[3] = cosine * cosine;
        feature[4] = 16 * a * b * cosine;
        feature[5] = high / (high + level);
        feature[6] = deep / (deep + level);
        feature[7] = 4 * sqrtf(near->weight[j] + 1e-4f);
        edge->a[j] = a, edge->b[j] = b;
    }
}

/* The messages of two edges, each a layer over its features, what both ends say added, and a second layer. */
INLINE void say(const Round *round, const float *const feature[2], Channels own, const float *const heard[2], float *const message[2],
                const int width) {
    Channels one = plus(own, load(heard[0], width), width), other = plus(own, load(heard[1], width), width);
    float hidden[2][MOST_CHANNELS];
    for (int i = 0; i < EDGE_FEATURES; i++) {
        const Channels weight = load(round->edge + i * width, width);
        one = plus_scaled(one, feature[0][i], weight, width), other = plus_scaled(other, feature[1][i], weight, width);
    }
    store(hidden[0], not_negative(one, width), width), store(hidden[1], not_negative(other, width), width);
    const float *const firsts[2] = {hidden[0], hidden[1]};
    second_layer(firsts, round->message, round->message_bias, message, width);
}

/* One exchange: (K, width) messages, and the point's features replaced by what it makes of them. */
INLINE void exchange(const Round *round, const Neighbourhood *near, const Edges *edge, const int32_t *index,
                     const float *heard, float *features, float *messages, const int width) {
    const Channels own = layer(load(round->edge_bias, width), features, CHANNELS, round->own, width);
    Channels mean, most;
    for (int j = 0; j < near->k; j += 2) {
        const int other = j + 1 < near->k ? j + 1 : j; /* the last of an odd number is made twice */
        const float *const feature[2] = {edge->feature[j], edge->feature[other]};
        const float *const said[2] = {heard + width * (size_t)index[j], heard + width * (size_t)index[other]};
        float *const message[2] = {messages + j * width, messages + other * width};
        say(round, feature, own, said, message, width);
    }
    pool(messages, near->weight, near->k, &mean, &most, width);
    float pooled[2 * MOST_CHANNELS], news[CHANNELS], average = 0, variance = 0;
    store(pooled, mean, width);
    store(pooled + width, most, width);
    store(news, layer(load(round->update_bias, CHANNELS), pooled, 2 * width, round->update, CHANNELS), CHANNELS);
    for (int c = 0; c < CHANNELS; c++) average += (news[c] += features[c]);
    average /= CHANNELS;
    for (int c = 0; c < CHANNELS; c++) variance += (news[c] - average) * (news[c] - average);
    const float sharpen = 1 / sqrtf(variance / CHANNELS + 1e-5f);
    for (int c = 0; c < CHANNELS; c++)
        features[c] = (news[c] - average) * sharpen * round->norm_gain[c] + round->norm_bias[c];
}

INLINE void step(const float *head, const Neighbourhood *near, const Edges *edge, const float *own,
                 const float *messages, float *move, const int width) {
    const float *bias = head + 3 * width;
    float total = 0, lifted = 0, x = 0, y = 0, z = 0;
    for (int j = 0; j < near->k; j++) {
        float known[3];
        for (int h = 0; h < 3; h++) {
            float sum = 0;
            for (int c = 0; c < width; c++) sum += head[h * width + c] * messages[j * width + c];
            known[h] = sum + bias[h];
        }
        const float bounded = 1 - 2 / (expf(known[0] / 2) + 1); /* tanh of a quarter */
        const float weight = near->weight[j] * expf(4 * bounded);
        const float pull = weight * (0.5f + known[1]) * edge->b[j];
        total += weight;
        x += pull * edge->nx[j], y += pull * edge->ny[j], z += pull * edge->nz[j];
        lifted += weight * (0.5f + known[2]) * edge->a[j];
    }
    const float length = near->scale / larger(total, 1e-12f);
    move[0] = length * (x + lifted * own[0]);
    move[1] = length * (y + lifted * own[1]);
    move[2] = length * (z + lifted * own[2]);
}

typedef struct {
    const float *normals, *their_normals; /* (M, 3), (N, 3) */
    const float *rounds, *head;           /* weights; no head, no step */
    const float *heard;                   /* what sources say in each round, one array (N, width) after the other */
    int64_t n_heard;                      /* floats in each of them */
    const float *before;                  /* (M, C) features so far */
    float *features, *moves;              /* (M, C), (M, 3) what comes of it */
    int n_rounds, width;
} Talk;

INLINE void talk_of_width(const Surroundings *around, int64_t start, int64_t stop, const Talk *talk, const int width) {
    Neighbourhood near;
    Edges edge;
    float messages[MOST_NEIGHBOURS * MOST_CHANNELS];
    for (int64_t i = start; i < stop; i++) {
        const int32_t *row = around->index + i * around->k;
        const float *normal = talk->normals + 3 * i, *weights = talk->rounds;
        float own[CHANNELS];
        neighbourhood(&near, around, i);
        edges(&edge, &near, normal, talk->their_normals, row, around->noise[i]);
        memcpy(own, talk->before + CHANNELS * i, sizeof own);
        for (int r = 0; r < talk->n_rounds; r++) {
            const Round round = next_round(&weights, width);
            exchange(&round, &near, &edge, row, talk->heard + r * talk->n_heard, own, messages, width);
        }
        memcpy(talk->features + CHANNELS * i, own, sizeof own);
        if (talk->head) step(talk->head, &near, &edge, normal, messages, talk->moves + 3 * i, width);
    }
}

/* Rounds of messages of the points in rows [start, stop), and their step where there is a head. */
static ANY_PROCESSOR void talk(const Surroundings *around, int64_t start, int64_t stop, const Talk *talk) {
    if (talk->width == CHANNELS) talk_of_width(around, start, stop, talk, CHANNELS);
    else talk_of_width(around, start, stop, talk, MOST_CHANNELS);
}

/* What sources say in a round, from their features. */
static ANY_PROCESSOR void hear(const float *features, int64_t start, int64_t stop, const float *weight, float *heard, int width) {
    for (int64_t i = start; i < stop; i++) {
        const float *feature = features + CHANNELS * i;
        if (width == CHANNELS) store(heard + width * i, layer(none(CHANNELS), feature, CHANNELS, weight, CHANNELS), CHANNELS);
        else store(heard + width * i, layer(none(MOST_CHANNELS), feature, CHANNELS, weight, MOST_CHANNELS), MOST_CHANNELS);
    }
}

/* For Python, which gives arrays by their addresses (fused.py) and lets other threads go on meanwhile. */

static int surroundings(PyObject *given, void *into) {
    unsigned long long points, sources, index, count, noise;
    Surroundings *around = into;
    if (!PyArg_ParseTuple(given, "KKKKiK", &points, &sources, &index, &count, &around->k, &noise)) return 0;
    around->points = AT(double, points), around->sources = AT(double, sources);
    around->index = AT(int32_t, index), around->count = AT(float, count);
    around->noise = AT(float, noise);
    return 1;
}

static PyObject *call_look(PyObject *self, PyObject *args) {
    Surroundings around;
    unsigned long long embedding, normals, shapes, features;
    long long start, stop;
    (void)self;
    if (!PyArg_ParseTuple(args, "O&LLKKKK", surroundings, &around, &start, &stop, &embedding, &normals, &shapes, &features))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    look(&around, start, stop, AT(Embedding, embedding), AT(float, normals), AT(float, shapes), AT(float, features));
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

static PyObject *call_hear(PyObject *self, PyObject *args) {
    unsigned long long features, weight, heard;
    long long start, stop;
    int width;
    (void)self;
    if (!PyArg_ParseTuple(args, "KLLKKi", &features, &start, &stop, &weight, &heard, &width)) return NULL;
    Py_BEGIN_ALLOW_THREADS
    hear(AT(float, features), start, stop, AT(float, weight), AT(float, heard), width);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

static PyObject *call_talk(PyObject *self, PyObject *args) {
    Surroundings around;
    Talk given;
    unsigned long long normals, their_normals, rounds, heard, before, features, head, moves;
    long long start, stop, n_heard;
    (void)self;
    if (!PyArg_ParseTuple(args, "O&LLKKKiKLKKKKi", surroundings, &around, &start, &stop, &normals, &their_normals, &rounds,
                          &given.n_rounds, &heard, &n_heard, &before, &features, &head, &moves, &given.width))
        return NULL;
    given.normals = AT(float, normals), given.their_normals = AT(float, their_normals);
    given.rounds = AT(float, rounds), given.head = AT(float, head);
    given.heard = AT(float, heard), given.n_heard = n_heard;
    given.before = AT(float, before), given.features = AT(float, features), given.moves = AT(float, moves);
    Py_BEGIN_ALLOW_THREADS
    talk(&around, start, stop, &given);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

static PyMethodDef functions[] = {
    {"look", call_look, METH_VARARGS, "Planes and first features of some points."},
    {"hear", call_hear, METH_VARARGS, "What some sources say in a round."},
    {"talk", call_talk, METH_VARARGS, "Rounds of messages of some points, and their step."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_fused", NULL, -1, functions, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__fused(void) { return PyModule_Create(&module); }
