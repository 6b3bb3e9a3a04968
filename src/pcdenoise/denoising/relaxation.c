/* Relaxation, point by point: what relaxation.py says in numpy, in a fraction of its time.

   Not here: neighbour search, blocks, threads. Arrays are dense, row by row, float64; a row of `index` begins with the point itself. */

#include <Python.h>

#include "../cloud/geometry.h"

#define MOST_DIRECTIONS 32

typedef struct {
    const int32_t *index; /* (N, k) */
    int k;
} Graph;

INLINE void away(double *offset, const double *from, const double *to) {
    for (int axis = 0; axis < 3; axis++) offset[axis] = to[axis] - from[axis];
}

/* What is left of a vector in the plane across a unit normal. */
INLINE void flatten(double *vector, const double *normal) {
    const double height = dot(vector, normal);
    for (int axis = 0; axis < 3; axis++) vector[axis] -= height * normal[axis];
}

/* From 0 to 1: how well two unit normals of either sign agree. */
INLINE double agreement(const double *one, const double *other) {
    const double cosine = dot(one, other), squared = cosine * cosine;
    return (squared * squared) * (squared * squared);
}

/* Unit normals of the points in rows [start, stop), and from 0, no surface, to 1, a sheet. */
static ANY_PROCESSOR void tangents(const double *points, Graph graph, int64_t start, int64_t stop, const double *planarity,
                                   double *normals, double *sheet) {
    for (int64_t i = start; i < stop; i++) {
        const int32_t *row = graph.index + i * graph.k;
        double mean[3] = {0, 0, 0}, matrix[3][3] = {{0}}, eigenvalues[3], root[3];
        for (int j = 0; j < graph.k; j++) {
            double offset[3];
            away(offset, points + 3 * i, points + 3 * (size_t)row[j]);
            for (int a = 0; a < 3; a++) mean[a] += offset[a] / graph.k;
        }
        for (int j = 0; j < graph.k; j++) {
            double spread[3];
            away(spread, points + 3 * i, points + 3 * (size_t)row[j]);
            for (int a = 0; a < 3; a++) spread[a] -= mean[a];
            for (int a = 0; a < 3; a++)
                for (int b = 0; b < 3; b++) matrix[a][b] += spread[a] * spread[b] / graph.k;
        }
        smallest_eigenvector((const double(*)[3])matrix, eigenvalues, normals + 3 * i);
        for (int a = 0; a < 3; a++) root[a] = sqrt(larger64(eigenvalues[a], 0));
        const double flat = ((root[1] - root[0]) / larger64(root[2], 1e-300) - planarity[0]) / (planarity[1] - planarity[0]);
        sheet[i] = flat < 0 ? 0 : flat > 1 ? 1 : flat;
    }
}

/* What bounds cells: `n` directions as n cosines and n sines; a cell with none within open[0] spacings begins to end at `wall`. */
typedef struct {
    const double *waves;
    int n;
    double open[2], wall;
} Directions;

/* Points one step further: to the centre of their cell in the tangent plane, held by where they began. */
static ANY_PROCESSOR void even(const double *points, const double *began, const double *normals, const double *spacing,
                               const double *held, const double *pace, Graph graph, Directions directions, int64_t start,
                               int64_t stop, double *evened) {
    for (int64_t i = start; i < stop; i++) {
        const int32_t *row = graph.index + i * graph.k;
        const double *own = points + 3 * i, *upright = normals + 3 * i;
        double first[3], second[3], bound[MOST_DIRECTIONS] = {0}, area = 0, centre[2] = {0, 0}, back[3];
        away(first, began + 3 * i, began + 3 * (size_t)row[1]);
        flatten(first, upright);
        const double length = larger64(sqrt(dot(first, first)), 1e-300);
        for (int axis = 0; axis < 3; axis++) first[axis] /= length;
        cross(second, upright, first);
        for (int j = 1; j < graph.k; j++) {
            double offset[3];
            away(offset, own, points + 3 * (size_t)row[j]);
            const double u = dot(offset, first), v = dot(offset, second), height = dot(offset, upright);
            const double squared = u * u + v * v + agreement(upright, normals + 3 * (size_t)row[j]) * height * height;
            const double nearness = 2 / larger64(squared, 1e-300);
            for (int d = 0; d < directions.n; d++)
                bound[d] = larger64(bound[d], nearness * (u * directions.waves[d] + v * directions.waves[directions.n + d]));
        }
        for (int d = 0; d < directions.n; d++) {
            const double furthest = directions.open[1] * spacing[i], reach = bound[d] * furthest > 1 ? 1 / bound[d] : furthest;
            const double is_open = larger64(reach - directions.open[0] * spacing[i], 0) / (furthest - directions.open[0] * spacing[i]);
            const double radius = reach + is_open * (directions.wall * spacing[i] - reach), squared = radius * radius;
            area += squared;
            centre[0] += squared * radius * directions.waves[d], centre[1] += squared * radius * directions.waves[directions.n + d];
        }
        away(back, own, began + 3 * i);
        flatten(back, upright);
        const double pull = 2. / 3 / larger64(area, 1e-300);
        for (int axis = 0; axis < 3; axis++) {
            const double to_centre = pull * (centre[0] * first[axis] + centre[1] * second[axis]);
            evened[3 * i + axis] = own[axis] + pace[i] * (to_centre + held[i] * back[axis]);
        }
    }
}

/* Points back on the surface through the starting points. */
static ANY_PROCESSOR void land(const double *points, const double *began, const double *normals, const double *sheet, Graph graph,
                               int64_t start, int64_t stop, double *landed) {
    for (int64_t i = start; i < stop; i++) {
        const int32_t *row = graph.index + i * graph.k;
        const double *own = points + 3 * i;
        double furthest = 1e-300, total = 0, matrix[3][3] = {{0}}, mean[3] = {0, 0, 0}, pulled[3] = {0, 0, 0};
        double eigenvalues[3], upright[3];
        for (int j = 0; j < graph.k; j++) {
            double offset[3];
            away(offset, own, began + 3 * (size_t)row[j]);
            furthest = larger64(furthest, dot(offset, offset));
        }
        for (int j = 0; j < graph.k; j++) {
            const double *normal = normals + 3 * (size_t)row[j];
            double offset[3];
            away(offset, own, began + 3 * (size_t)row[j]);
            const double falling = 1 - dot(offset, offset) / furthest;
            const double weight = falling * falling * agreement(normals + 3 * i, normal) + 1e-12;
            const double depth = dot(offset, normal);
            total += weight;
            for (int a = 0; a < 3; a++) {
                mean[a] += weight * offset[a];
                pulled[a] += weight * depth * normal[a];
                for (int b = 0; b < 3; b++) matrix[a][b] -= weight * normal[a] * normal[b];
            }
        }
        smallest_eigenvector((const double(*)[3])matrix, eigenvalues, upright);
        const double over = dot(mean, upright), share = 0.5 * sheet[i] / total;
        for (int axis = 0; axis < 3; axis++) landed[3 * i + axis] = own[axis] + share * (pulled[axis] + over * upright[axis]);
    }
}

/* For Python, which gives arrays by their addresses (relaxation.py) and lets other threads go on meanwhile. */

static int graph_of(PyObject *given, void *into) {
    unsigned long long index;
    Graph *graph = into;
    if (!PyArg_ParseTuple(given, "Ki", &index, &graph->k)) return 0;
    graph->index = AT(int32_t, index);
    return 1;
}

static PyObject *call_tangents(PyObject *self, PyObject *args) {
    Graph graph;
    unsigned long long points, normals, sheet;
    long long start, stop;
    double planarity[2];
    (void)self;
    if (!PyArg_ParseTuple(args, "O&LLKddKK", graph_of, &graph, &start, &stop, &points, planarity, planarity + 1, &normals, &sheet))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    tangents(AT(double, points), graph, start, stop, planarity, AT(double, normals), AT(double, sheet));
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

static PyObject *call_even(PyObject *self, PyObject *args) {
    Graph graph;
    Directions directions;
    unsigned long long points, began, normals, spacing, held, pace, waves, evened;
    long long start, stop;
    (void)self;
    if (!PyArg_ParseTuple(args, "O&LLKKKKKKKidddK", graph_of, &graph, &start, &stop, &points, &began, &normals, &spacing, &held,
                          &pace, &waves, &directions.n, directions.open, directions.open + 1, &directions.wall, &evened))
        return NULL;
    if (directions.n > MOST_DIRECTIONS) return PyErr_Format(PyExc_ValueError, "at most %d directions", MOST_DIRECTIONS);
    directions.waves = AT(double, waves);
    Py_BEGIN_ALLOW_THREADS
    even(AT(double, points), AT(double, began), AT(double, normals), AT(double, spacing), AT(double, held), AT(double, pace), graph,
         directions, start, stop, AT(double, evened));
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

static PyObject *call_land(PyObject *self, PyObject *args) {
    Graph graph;
    unsigned long long points, began, normals, sheet, landed;
    long long start, stop;
    (void)self;
    if (!PyArg_ParseTuple(args, "O&LLKKKKK", graph_of, &graph, &start, &stop, &points, &began, &normals, &sheet, &landed))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    land(AT(double, points), AT(double, began), AT(double, normals), AT(double, sheet), graph, start, stop, AT(double, landed));
    Py_END_ALLOW_THREADS
    Py_RETURN_NONE;
}

static PyMethodDef functions[] = {
    {"tangents", call_tangents, METH_VARARGS, "Normals of some points, and how much of a sheet is there."},
    {"even", call_even, METH_VARARGS, "Some points one step nearer to the centres of their cells."},
    {"land", call_land, METH_VARARGS, "Some points back on the surface."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_relaxation", NULL, -1, functions, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__relaxation(void) { return PyModule_Create(&module); }
