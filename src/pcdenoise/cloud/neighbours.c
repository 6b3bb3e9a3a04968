/* The nearest of many points, by a k-d tree.

   Not here: blocks, threads, order of points. Arrays are dense, row by row. */

#include <Python.h>
#include <stdlib.h>

#include "geometry.h"

#define LEAF 32 /* most points of a node that is not halved */
#define MOST_LEVELS 32

/* Points in order of the leaves that hold them. Node i is halved into 2i + 1 and 2i + 2 by number, across its longest side. */
typedef struct {
    const double *axes;  /* (3, n) coordinates */
    const int32_t *rows; /* (n,) where each point was before */
    const double *boxes; /* (nodes, 6) of the points of each node: lowest corner, highest corner */
    int64_t n;
    int levels; /* of nodes that are halved */
} Tree;

/* A point by what it is ordered by, a coordinate or a squared distance; by its row where that is equal. */
typedef struct {
    double key;
    int64_t row;
} Item;

typedef struct {
    int64_t node, start, stop;
    int levels;
    double squared; /* distance of its box */
} Branch;

INLINE int is_before(Item one, Item other) { return one.key < other.key || (one.key == other.key && one.row < other.row); }

/* Puts the nth item in its place, smaller ones before it and larger ones behind. No order of items is bad: pivots are drawn. */
static void select_nth(Item *items, int64_t n, int64_t nth) {
    uint64_t drawn = 88172645463325252u;
    int64_t low = 0, high = n - 1;
    while (low < high) {
        drawn ^= drawn << 13, drawn ^= drawn >> 7, drawn ^= drawn << 17;
        const Item pivot = items[low + (int64_t)(drawn % (uint64_t)(high - low + 1))];
        int64_t i = low, j = high;
        while (i <= j) {
            while (is_before(items[i], pivot)) i++;
            while (is_before(pivot, items[j])) j--;
            if (i > j) break;
            const Item swapped = items[i];
            items[i++] = items[j], items[j--] = swapped;
        }
        if (nth <= j) high = j;
        else if (nth >= i) low = i;
        else return;
    }
}

/* Numbers too large to be scaled share the last bin. */
INLINE int64_t bin_of(double above, double scale, int64_t n) {
    const double bin = above * scale;
    return bin < (double)n ? (int64_t)bin : n - 1;
}

/* Items in order. Squared distances of points on a surface are spread evenly, so that each has a bin almost to itself and only
   neighbours are left to exchange. room: for n items and n + 2 numbers. */
INLINE void sort(Item *items, int64_t n, Item *room, int32_t *bins) {
    double low = items[0].key, high = low;
    for (int64_t i = 1; i < n; i++) {
        const double key = items[i].key;
        low = key < low ? key : low, high = larger64(high, key);
    }
    const double scale = high > low ? (double)(n - 1) / (high - low) : 0;
    memset(bins, 0, (size_t)(n + 2) * sizeof *bins);
    for (int64_t i = 0; i < n; i++) bins[bin_of(items[i].key - low, scale, n) + 2]++;
    for (int64_t i = 2; i <= n; i++) bins[i] += bins[i - 1];
    for (int64_t i = 0; i < n; i++) room[bins[bin_of(items[i].key - low, scale, n) + 1]++] = items[i];
    for (int64_t i = 0; i < n; i++) {
        const Item moved = room[i];
        int64_t j = i;
        for (; j > 0 && is_before(moved, items[j - 1]); j--) items[j] = items[j - 1];
        items[j] = moved;
    }
}

static int levels_of(int64_t n) {
    int levels = 0;
    while (((n - 1) >> levels) + 1 > LEAF) levels++;
    return levels;
}

static void halve(const double *points, Item *items, int64_t n, int64_t node, int levels, double *boxes) {
    double *low = boxes + 6 * node, *high = low + 3;
    for (int a = 0; a < 3; a++) low[a] = high[a] = points[3 * items[0].row + a];
    for (int64_t i = 1; i < n; i++)
        for (int a = 0; a < 3; a++) {
            const double at = points[3 * items[i].row + a];
            low[a] = at < low[a] ? at : low[a], high[a] = at > high[a] ? at : high[a];
        }
    if (levels == 0) return;
    int longest = 0;
    for (int a = 1; a < 3; a++)
        if (high[a] - low[a] > high[longest] - low[longest]) longest = a;
    for (int64_t i = 0; i < n; i++) items[i].key = points[3 * items[i].row + longest];
    select_nth(items, n, n / 2);
    halve(points, items, n / 2, 2 * node + 1, levels - 1, boxes);
    halve(points, items + n / 2, n - n / 2, 2 * node + 2, levels - 1, boxes);
}

/* What a tree is made of; 0 where there is no memory for it. */
static int plant(const double *points, int64_t n, double *axes, int32_t *rows, double *boxes) {
    Item *items = malloc((size_t)n * sizeof *items);
    if (items == NULL) return 0;
    for (int64_t i = 0; i < n; i++) items[i].row = i;
    halve(points, items, n, 0, levels_of(n), boxes);
    for (int64_t i = 0; i < n; i++) {
        for (int a = 0; a < 3; a++) axes[a * n + i] = points[3 * items[i].row + a];
        rows[i] = (int32_t)items[i].row;
    }
    free(items);
    return 1;
}

INLINE double to_box(const double *query, const double *box) {
    double squared = 0;
    for (int a = 0; a < 3; a++) {
        const double outside = larger64(larger64(box[a] - query[a], query[a] - box[a + 3]), 0);
        squared += outside * outside;
    }
    return squared * (1 - 1e-15); /* never more than that of a point in it, however either is rounded */
}

/* The k points nearest to a query by squared distance, nearest first; none is farther than the root of `bound`.
   found, room: for 2k + LEAF items. */
INLINE void nearest_to(const double *query, Tree tree, int64_t k, double bound, Item *found, Item *room, int32_t *bins) {
    Branch waiting[MOST_LEVELS], branch = {0, 0, tree.n, tree.levels, 0};
    int n_waiting = 0;
    int64_t n = 0;
    for (;;) {
        while (branch.levels > 0) {
            const int64_t middle = branch.start + (branch.stop - branch.start) / 2, left = 2 * branch.node + 1;
            const double to_left = to_box(query, tree.boxes + 6 * left), to_right = to_box(query, tree.boxes + 6 * left + 6);
            const Branch halves[2] = {{left, branch.start, middle, branch.levels - 1, to_left},
                                      {left + 1, middle, branch.stop, branch.levels - 1, to_right}};
            const int nearer = to_right < to_left;
            if (halves[!nearer].squared <= bound) waiting[n_waiting++] = halves[!nearer];
            branch = halves[nearer];
        }
        double squared[LEAF];
        const double *x = tree.axes + branch.start, *y = x + tree.n, *z = y + tree.n;
        const int size = (int)(branch.stop - branch.start);
        for (int i = 0; i < size; i++) {
            const double u = x[i] - query[0], v = y[i] - query[1], w = z[i] - query[2];
            squared[i] = u * u + v * v + w * w;
        }
        for (int i = 0; i < size; i++) {
            found[n].key = squared[i], found[n].row = tree.rows[branch.start + i];
            n += squared[i] <= bound;
        }
        if (n >= 2 * k) {
            sort(found, n, room, bins);
            n = k, bound = found[k - 1].key;
        }
        do {
            if (n_waiting == 0) {
                sort(found, n, room, bins);
                for (; n < k; n++) found[n].key = INFINITY, found[n].row = tree.n; /* where numbers are none */
                return;
            }
            branch = waiting[--n_waiting];
        } while (branch.squared > bound);
    }
}

/* For the queries in rows [start, stop) the k nearest of at least as many points: rows (M, k), distances (M, k) if asked for.
   found: for twice 2k + LEAF items and bins. */
static ANY_PROCESSOR void nearest(const double *queries, Tree tree, int64_t start, int64_t stop, int64_t k, Item *found,
                                  double *distances, int32_t *rows, int64_t *wide_rows) {
    const int64_t most = 2 * k + LEAF;
    for (int64_t i = start; i < stop; i++) {
        const double *query = queries + 3 * i;
        double bound = INFINITY;
        if (i > start) { /* as far as the last of the query before, and the way from there: near, where queries lie in order */
            double way[3] = {query[0] - query[-3], query[1] - query[-2], query[2] - query[-1]};
            const double reach = (sqrt(found[k - 1].key) + sqrt(dot(way, way))) * (1 + 1e-9);
            if (reach >= 0) bound = reach * reach + 1e-300; /* squares of tiny lengths are lost */
        }
        nearest_to(query, tree, k, bound, found, found + most, (int32_t *)(found + 2 * most));
        for (int64_t j = 0; j < k; j++) {
            if (distances) distances[i * k + j] = sqrt(found[j].key);
            if (rows) rows[i * k + j] = (int32_t)found[j].row;
            else wide_rows[i * k + j] = found[j].row;
        }
    }
}

/* For Python, which gives arrays by their addresses (neighbours.py) and lets other threads go on meanwhile. */

static PyObject *call_n_nodes(PyObject *self, PyObject *args) {
    long long n;
    (void)self;
    if (!PyArg_ParseTuple(args, "L", &n)) return NULL;
    return PyLong_FromLongLong(((int64_t)2 << levels_of(n)) - 1);
}

static PyObject *call_plant(PyObject *self, PyObject *args) {
    unsigned long long points, axes, rows, boxes;
    long long n;
    int is_planted;
    (void)self;
    if (!PyArg_ParseTuple(args, "KLKKK", &points, &n, &axes, &rows, &boxes)) return NULL;
    Py_BEGIN_ALLOW_THREADS
    is_planted = plant(AT(double, points), n, AT(double, axes), AT(int32_t, rows), AT(double, boxes));
    Py_END_ALLOW_THREADS
    if (!is_planted) return PyErr_NoMemory();
    Py_RETURN_NONE;
}

static PyObject *call_nearest(PyObject *self, PyObject *args) {
    unsigned long long queries, axes, tree_rows, boxes, distances, rows, wide_rows;
    long long n, start, stop, k;
    (void)self;
    if (!PyArg_ParseTuple(args, "(KKKL)KLLLKKK", &axes, &tree_rows, &boxes, &n, &queries, &start, &stop, &k, &distances, &rows, &wide_rows))
        return NULL;
    Item *found = malloc((size_t)(3 * (2 * k + LEAF)) * sizeof *found);
    if (found == NULL) return PyErr_NoMemory();
    const Tree tree = {AT(double, axes), AT(int32_t, tree_rows), AT(double, boxes), n, levels_of(n)};
    Py_BEGIN_ALLOW_THREADS
    nearest(AT(double, queries), tree, start, stop, k, found, AT(double, distances), AT(int32_t, rows), AT(int64_t, wide_rows));
    Py_END_ALLOW_THREADS
    free(found);
    Py_RETURN_NONE;
}

static PyMethodDef functions[] = {
    {"n_nodes", call_n_nodes, METH_VARARGS, "How many nodes a tree over so many points has."},
    {"plant", call_plant, METH_VARARGS, "A tree over points."},
    {"nearest", call_nearest, METH_VARARGS, "The nearest points of some queries."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_neighbours", NULL, -1, functions, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__neighbours(void) { return PyModule_Create(&module); }
