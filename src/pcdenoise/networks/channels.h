/* Channels of features and messages, eight at a time. Not here: what is done with them (fused.c, exchange.c). */

#define CHANNELS 32 /* of a point's features */
#define MOST_CHANNELS 48 /* of a message: 32 or so many, which every function below is compiled for on its own */
#define LANES 8
#define EDGE_FEATURES 8
#define MOST_NEIGHBOURS 64

typedef float Lanes __attribute__((vector_size(LANES * sizeof(float)), aligned(4), may_alias));
typedef int32_t Mask __attribute__((vector_size(LANES * sizeof(int32_t)), aligned(4), may_alias));
typedef struct { Lanes part[MOST_CHANNELS / LANES]; } Channels; /* the first of them, as many as are in use */

INLINE float larger(float one, float other) { return one > other ? one : other; }

INLINE Channels load(const float *from, const int width) {
    Channels c;
    for (int v = 0; v < width / LANES; v++) c.part[v] = ((const Lanes *)from)[v];
    return c;
}

INLINE void store(float *to, Channels c, const int width) {
    for (int v = 0; v < width / LANES; v++) ((Lanes *)to)[v] = c.part[v];
}

INLINE Channels none(const int width) {
    Channels c;
    for (int v = 0; v < width / LANES; v++) c.part[v] = (Lanes){0};
    return c;
}

INLINE Channels not_negative(Channels c, const int width) { /* a NaN stays one */
    for (int v = 0; v < width / LANES; v++) c.part[v] = (Lanes)((Mask)c.part[v] & ~(c.part[v] < 0));
    return c;
}

INLINE Channels plus(Channels sum, Channels c, const int width) {
    for (int v = 0; v < width / LANES; v++) sum.part[v] += c.part[v];
    return sum;
}

INLINE Channels plus_scaled(Channels sum, float factor, Channels c, const int width) {
    for (int v = 0; v < width / LANES; v++) sum.part[v] += factor * c.part[v];
    return sum;
}

INLINE Channels layer(Channels sum, const float *input, int n, const float *weight, const int width) {
    for (int i = 0; i < n; i++) sum = plus_scaled(sum, input[i], load(weight + i * width, width), width);
    return sum;
}

INLINE float largest(const float *values, int n) {
    float most = 1e-12f;
    for (int j = 0; j < n; j++) most = larger(most, values[j]);
    return most;
}

/* The second layer of the messages of two edges, from what the first gives. Two at a time share every load of a weight and keep
   eight or twelve sums going, as many as the processor's multipliers take to be busy. */
INLINE void second_layer(const float *const hidden[2], const float *weights, const float *bias, float *const message[2],
                         const int width) {
    Channels one = load(bias, width), other = one;
    for (int i = 0; i < width; i++) {
        const Channels weight = load(weights + i * width, width);
        one = plus_scaled(one, hidden[0][i], weight, width), other = plus_scaled(other, hidden[1][i], weight, width);
    }
    store(message[0], not_negative(one, width), width), store(message[1], not_negative(other, width), width);
}

/* The weighted mean and the most of k messages, weights of sum one as shares of the largest. */
INLINE void pool(const float *messages, const float *weights, int k, Channels *mean, Channels *most, const int width) {
    const float most_weight = largest(weights, k);
    *mean = none(width), *most = none(width);
    for (int j = 0; j < k; j++) {
        const Channels message = load(messages + j * width, width);
        const float weight = weights[j], share = weight / most_weight;
        for (int v = 0; v < width / LANES; v++) {
            const Lanes shared = share * message.part[v];
            const Mask more = shared > most->part[v];
            mean->part[v] += weight * message.part[v];
            most->part[v] = (Lanes)(((Mask)shared & more) | ((Mask)most->part[v] & ~more));
        }
    }
}
