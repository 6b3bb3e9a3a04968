/* Messages along all edges and the derivative of them, point by point: a point's edges never leave the first cache.

   The same as exchange.py does with torch, which says what it means; what the derivative needs of the first layer is made anew
   rather than kept. Not here: blocks, threads, what is learned with it. Everything is float32.
   Arrays are dense and row by row, but features of edges come one after the other: (F, M, K). A layer's weights come as torch has
   them, (outputs, inputs), and the other way round, as each product is fastest. */

#include <Python.h>

#include "../cloud/geometry.h"
#include "channels.h"

typedef struct {
    const float *features, *own, *heard;     /* (F, M, K), (M, C), (N, C) */
    const int32_t *source;                   /* (M, K) rows of the sources */
    const float *weight;                     /* (M, K) of sum one */
    const float *first, *first_bias;         /* (F, C), (C,) */
    const float *second, *second_bias;       /* (C, C) inputs by outputs, (C,) */
    const float *second_turned;              /* (C, C) outputs by inputs */
    const float *head, *head_bias;           /* (3, C), (3,), or none */
    float *mean, *most, *known;              /* (M, C), (M, C), and (3, M, K) where there is a head */
    int64_t n;
    int k, width;
} Exchange;

typedef struct {
    const float *mean, *most, *known;        /* of the loss by what an exchange gives; each may be none */
    float *features, *own, *heard;           /* of the loss by what it was given; features may be none; heard is added to */
    float *first, *second, *second_bias;     /* (F, C), (C, C) outputs by inputs, (C,), added to */
    float *head, *head_bias;                 /* (3, C), (3,), added to where there is one */
} Derivative;

/* What the first layer says along an edge, before it is cut at zero; two edges at a time. */
INLINE void hear_edges(const Exchange *given, int64_t i, int j, int other, Channels own, Channels *one, Channels *two, const int width) {
    const int64_t edge = i * given->k, edges = given->n * given->k;
    *one = plus(own, load(given->heard + width * (size_t)given->source[edge + j], width), width);
    *two = plus(own, load(given->heard + width * (size_t)given->source[edge + other], width), width);
    for (int f = 0; f < EDGE_FEATURES; f++) {
        const Channels weight = load(given->first + f * width, width);
        const float *feature = given->features + f * edges + edge;
        *one = plus_scaled(*one, feature[j], weight, width), *two = plus_scaled(*two, feature[other], weight, width);
    }
}

/* The messages (K, C) of a point and, for their derivative, what the first layer gives (K, C) cut at zero. */
INLINE void say(const Exchange *given, int64_t i, float *hidden, float *messages, const int width) {
    const Channels own = plus(load(given->own + i * width, width), load(given->first_bias, width), width);
    for (int j = 0; j < given->k; j += 2) {
        const int other = j + 1 < given->k ? j + 1 : j; /* the last of an odd number is made twice */
        Channels one, two;
        hear_edges(given, i, j, other, own, &one, &two, width);
        store(hidden + j * width, not_negative(one, width), width), store(hidden + other * width, not_negative(two, width), width);
        const float *const firsts[2] = {hidden + j * width, hidden + other * width};
        float *const message[2] = {messages + j * width, messages + other * width};
        second_layer(firsts, given->second, given->second_bias, message, width);
    }
}

INLINE void forward_of_width(const Exchange *given, int64_t start, int64_t stop, const int width) {
    const int k = given->k;
    float hidden[MOST_NEIGHBOURS * MOST_CHANNELS], messages[MOST_NEIGHBOURS * MOST_CHANNELS];
    for (int64_t i = start; i < stop; i++) {
        Channels mean, most;
        say(given, i, hidden, messages, width);
        pool(messages, given->weight + i * k, k, &mean, &most, width);
        store(given->mean + i * width, mean, width);
        store(given->most + i * width, most, width);
        for (int h = 0; given->head && h < 3; h++) {
            float *known = given->known + (h * given->n + i) * k;
            for (int j = 0; j < k; j++) {
                float sum = 0;
                for (int c = 0; c < width; c++) sum += given->head[h * width + c] * messages[j * width + c];
                known[j] = sum + given->head_bias[h];
            }
        }
    }
}

/* sum[a][b] += Σ_j left[j][a] * right[j][b], two rows of the sum at a time. */
INLINE void add_products(float *sum, const float *left, int n_left, const float *right, int k, const int width) {
    for (int a = 0; a < n_left; a += 2) {
        Channels one = load(sum + a * width, width), two = load(sum + (a + 1) * width, width);
        for (int j = 0; j < k; j++) {
            const Channels row = load(right + j * width, width);
            one = plus_scaled(one, left[j * n_left + a], row, width), two = plus_scaled(two, left[j * n_left + a + 1], row, width);
        }
        store(sum + a * width, one, width), store(sum + (a + 1) * width, two, width);
    }
}

INLINE Channels where_positive(Channels c, Channels sign, const int width) {
    for (int v = 0; v < width / LANES; v++) c.part[v] = (Lanes)((Mask)c.part[v] & (sign.part[v] > 0));
    return c;
}

INLINE void backward_of_width(const Exchange *given, int64_t start, int64_t stop, const Derivative *of, const int width) {
    const int k = given->k;
    const int64_t edges = given->n * k;
    float hidden[MOST_NEIGHBOURS * MOST_CHANNELS], messages[MOST_NEIGHBOURS * MOST_CHANNELS];
    float of_hidden[MOST_NEIGHBOURS * MOST_CHANNELS], of_message[MOST_NEIGHBOURS * MOST_CHANNELS];
    float features[MOST_NEIGHBOURS * EDGE_FEATURES];
    for (int64_t i = start; i < stop; i++) {
        Channels mean, most; /* made anew as well: an equal value is looked for, which another rounding would hide */
        say(given, i, hidden, messages, width);
        pool(messages, given->weight + i * k, k, &mean, &most, width);
        const Channels of_mean = of->mean ? load(of->mean + i * width, width) : none(width);
        const Channels of_most = of->most ? load(of->most + i * width, width) : none(width);
        const float most_weight = largest(given->weight + i * k, k);
        Channels of_bias = load(of->second_bias, width), of_own = none(width);
        for (int j = 0; j < k; j++) {
            const Channels message = load(messages + j * width, width);
            const float weight = given->weight[i * k + j], share = weight / most_weight;
            Channels sum = none(width);
            for (int v = 0; v < width / LANES; v++) {
                const Mask is_most = (share * message.part[v] == most.part[v]);
                sum.part[v] += weight * of_mean.part[v] + (Lanes)((Mask)(share * of_most.part[v]) & is_most);
            }
            for (int h = 0; of->known && h < 3; h++) {
                const float by_known = of->known[(h * given->n + i) * k + j];
                float *of_head = of->head + h * width;
                sum = plus_scaled(sum, by_known, load(given->head + h * width, width), width);
                store(of_head, plus_scaled(load(of_head, width), by_known, message, width), width);
                of->head_bias[h] += by_known;
            }
            sum = where_positive(sum, message, width);
            of_bias = plus(of_bias, sum, width);
            store(of_message + j * width, sum, width);
        }
        store(of->second_bias, of_bias, width);
        for (int j = 0; j < k; j += 2) {
            const int other = j + 1 < k ? j + 1 : j;
            Channels one = none(width), two = none(width);
            for (int c = 0; c < width; c++) {
                const Channels weight = load(given->second_turned + c * width, width);
                one = plus_scaled(one, of_message[j * width + c], weight, width);
                two = plus_scaled(two, of_message[other * width + c], weight, width);
            }
            store(of_hidden + j * width, where_positive(one, load(hidden + j * width, width), width), width);
            store(of_hidden + other * width, where_positive(two, load(hidden + other * width, width), width), width);
        }
        for (int j = 0; j < k; j++) {
            float *heard = of->heard + width * (size_t)given->source[i * k + j];
            const Channels some = load(of_hidden + j * width, width);
            of_own = plus(of_own, some, width);
            store(heard, plus(load(heard, width), some, width), width);
            for (int f = 0; f < EDGE_FEATURES; f++) features[j * EDGE_FEATURES + f] = given->features[f * edges + i * k + j];
        }
        store(of->own + i * width, of_own, width);
        add_products(of->second, of_message, width, hidden, k, width);
        add_products(of->first, features, EDGE_FEATURES, of_hidden, k, width);
        if (!of->features) continue;
        for (int f = 0; f < EDGE_FEATURES; f++) {
            const float *weight = given->first + f * width;
            for (int j = 0; j < k; j++) {
                float sum = 0;
                for (int c = 0; c < width; c++) sum += weight[c] * of_hidden[j * width + c];
                of->features[f * edges + i * k + j] = sum;
            }
        }
    }
}

static ANY_PROCESSOR void forward(const Exchange *given, int64_t start, int64_t stop) {
    if (given->width == CHANNELS) forward_of_width(given, start, stop, CHANNELS);
    else forward_of_width(given, start, stop, MOST_CHANNELS);
}

static ANY_PROCESSOR void backward(const Exchange *given, int64_t start, int64_t stop, const Derivative *of) {
    if (given->width == CHANNELS) backward_of_width(given, start, stop, of, CHANNELS);
    else backward_of_width(given, start, stop, of, MOST_CHANNELS);
}

/* For Python, which gives arrays by their addresses (exchange.py) and lets other threads go on meanwhile. */

static int exchange(PyObject *from, void *into) {
    unsigned long long features, own, heard, source, weight, first, first_bias, second, second_bias, turned, head, head_bias;
    unsigned long long mean, most, known;
    long long n;
    Exchange *given = into;
    if (!PyArg_ParseTuple(from, "KKKKKKKKKKKKKKKLii", &features, &own, &heard, &source, &weight, &first, &first_bias, &second,
                          &second_bias, &turned, &head, &head_bias, &mean, &most, &known, &n, &given->k, &given->width))
        return 0;
    given->features = AT(float, features), given->own = AT(float, own), given->heard = AT(float, heard);
    given->source = AT(int32_t, source), given->weight = AT(float, weight);
    given->first = AT(float, first), given->first_bias = AT(float, first_bias);
    given->second = AT(float, second), given->second_bias = AT(float, second_bias), given->second_turned = AT(float, turned);
    given->head = AT(float, head), given->head_bias = AT(float, head_bias);
    given->mean = AT(float, mean), given->most = AT(float, most), given->known = AT(float, known);
    given->n = n;
    return 1;
}

static PyObject *call_forward(PyObject *self, PyObject *args) {
    Exchange given;
    long long start, stop;
    (void)self;
    if (!PyArg_ParseTuple(args, "O&LL", exchange, &given, &start, &stop)) return NULL;
    Py_BEGIN_ALLOW_THREADS
    forward(&given, start, stop);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

static PyObject *call_backward(PyObject *self, PyObject *args) {
    Exchange given;
    Derivative of;
    unsigned long long mean, most, known, features, own, heard, first, second, second_bias, head, head_bias;
    long long start, stop;
    (void)self;
    if (!PyArg_ParseTuple(args, "O&LLKKKKKKKKKKK", exchange, &given, &start, &stop, &mean, &most, &known, &features, &own, &heard,
                          &first, &second, &second_bias, &head, &head_bias))
        return NULL;
    of.mean = AT(float, mean), of.most = AT(float, most), of.known = AT(float, known);
    of.features = AT(float, features), of.own = AT(float, own), of.heard = AT(float, heard);
    of.first = AT(float, first), of.second = AT(float, second), of.second_bias = AT(float, second_bias);
    of.head = AT(float, head), of.head_bias = AT(float, head_bias);
    Py_BEGIN_ALLOW_THREADS
    backward(&given, start, stop, &of);
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

static PyMethodDef functions[] = {
    {"forward", call_forward, METH_VARARGS, "Messages along the edges of some points, and what points hear of them."},
    {"backward", call_backward, METH_VARARGS, "The derivative of that."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_exchange", NULL, -1, functions, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__exchange(void) { return PyModule_Create(&module); }
