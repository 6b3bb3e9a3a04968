/* Channels of features and messages, eight at a time. Not here: what is done with them (fused.c, exchange.c). */

#define CHANNELS 32 /* of a point's features */
#define MOST_CHANNELS 48 /* of a message: 32 or so many, which every function below is compiled for on its own */
#define LANES 8
#define EDGE_FEATURES 8

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
