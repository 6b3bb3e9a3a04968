/* Vectors, the axes of a covariance, and what the C files of this program share. Not here: what is done with them. */

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 12
#define ANY_PROCESSOR __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define ANY_PROCESSOR
#endif
#define INLINE static inline __attribute__((always_inline))

/* An array that Python gave by its address. */
#define AT(type, address) ((type *)(uintptr_t)(address))

INLINE double larger64(double one, double other) { return one > other ? one : other; }

INLINE void cross(double *result, const double *u, const double *v) {
    result[0] = u[1] * v[2] - u[2] * v[1];
    result[1] = u[2] * v[0] - u[0] * v[2];
    result[2] = u[0] * v[1] - u[1] * v[0];
}

INLINE double dot(const double *u, const double *v) { return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]; }

/* As smallest_eigenvector in projection.py: ascending eigenvalues, and the unit eigenvector of the smallest. */
INLINE void smallest_eigenvector(const double matrix[3][3], double *eigenvalues, double *vector) {
    const double mean = (matrix[0][0] + matrix[1][1] + matrix[2][2]) / 3;
    double rows[3][3], squared = 0;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            rows[i][j] = matrix[i][j] - (i == j ? mean : 0);
            squared += rows[i][j] * rows[i][j];
        }
    const double size = larger64(sqrt(squared / 6), 1e-150);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) rows[i][j] /= size;
    double normal[3];
    cross(normal, rows[1], rows[2]);
    const double half = dot(rows[0], normal) / 2;
    const double angle = acos(half < -1 ? -1 : half > 1 ? 1 : half) / 3, third = 2.0943951023931953;
    const double least = 2 * cos(angle + third);
    eigenvalues[0] = mean + size * least;
    eigenvalues[1] = mean + size * 2 * cos(angle + 2 * third);
    eigenvalues[2] = mean + size * 2 * cos(angle);
    for (int i = 0; i < 3; i++) rows[i][i] -= least;
    double crosses[3][3], longest = -1;
    int best = 0;
    cross(crosses[0], rows[0], rows[1]);
    cross(crosses[1], rows[0], rows[2]);
    cross(crosses[2], rows[1], rows[2]);
    for (int i = 0; i < 3; i++) {
        const double length = sqrt(dot(crosses[i], crosses[i]));
        if (length > longest) longest = length, best = i;
    }
    memcpy(vector, crosses[best], sizeof crosses[best]);
    if (longest < 1e-12) { /* all rows lie along the one large eigenvalue's vector: any direction across it will do */
        int along = 0, axis = 0;
        for (int i = 1; i < 3; i++)
            if (dot(rows[i], rows[i]) > dot(rows[along], rows[along])) along = i;
        for (int i = 1; i < 3; i++)
            if (fabs(rows[along][i]) < fabs(rows[along][axis])) axis = i;
        double unit[3] = {0, 0, 0};
        unit[axis] = 1;
        cross(vector, rows[along], unit);
        longest = sqrt(dot(vector, vector));
    }
    for (int i = 0; i < 3; i++) vector[i] /= larger64(longest, 1e-150);
}
