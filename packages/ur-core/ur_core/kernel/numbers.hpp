// Arithmetic on the twelve joints of a cell, sines and cosines, and vectors of three.
//
// Every sum has a fixed order, and nothing is contracted to fused multiplications: a cell's numbers do not depend on
// the batch, the thread, or the processor.
#pragma once

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

constexpr int64_t JOINTS = 12;

// Memory for numbers whose count has no bound: threads may have small stacks.
struct Scratch {
    double* const data;

    explicit Scratch(int64_t size) : data(static_cast<double*>(malloc(sizeof(double) * static_cast<uint64_t>(size)))) {
        if (data == nullptr && size > 0) abort();  // the arms' watchdogs stop them
    }
    ~Scratch() { free(data); }
    Scratch(const Scratch&) = delete;
    Scratch& operator=(const Scratch&) = delete;
    operator double*() const { return data; }
};

static inline double smaller(double a, double b) { return a < b ? a : b; }
static inline double larger(double a, double b) { return a > b ? a : b; }
static inline double clamp(double value, double low, double high) { return smaller(larger(value, low), high); }

static inline void copy(double* to, const double* from, int64_t count) {
    memcpy(to, from, sizeof(double) * static_cast<uint64_t>(count));
}

// One row of a product with joint values: sum over k of weights[k] * values[k], each (12,).
static inline void weighted(const double* weights, int64_t first, int64_t last, const double* values, double* out) {
    double sum[JOINTS] = {};
    for (int64_t k = first; k < last; ++k)
        for (int64_t j = 0; j < JOINTS; ++j) sum[j] += weights[k] * values[k * JOINTS + j];
    copy(out, sum, JOINTS);
}

// out (rows, 12) = matrix (rows, columns) @ values (columns, 12).
static inline void multiply(const double* matrix, int64_t rows, int64_t columns, const double* values, double* out) {
    for (int64_t row = 0; row < rows; ++row)
        weighted(matrix + row * columns, 0, columns, values, out + row * JOINTS);
}

// The larger of two numbers, or NaN if one is.
static inline double larger_or_nan(double a, double b) { return a > b || a != a ? a : b; }

struct SineCosine {
    double sine, cosine;
};

// Sine and cosine by Taylor series on [-pi/4, pi/4], whose remainders stay below 1e-18. Angles up to 1e6 rad are
// reduced with pi/2 in three parts, of which the products with the first two are exact; larger ones give NaN. The same
// bits on every platform, which those of the mathematical libraries are not.
static inline SineCosine sine_cosine(double angle) {
    if (!(fabs(angle) <= 1e6)) return {NAN, NAN};
    const double nearest = 6755399441055744.0;  // 1.5 * 2^52: adding it rounds to an integer
    const double turns = (angle * 0.63661977236758134308 + nearest) - nearest;
    const double x = ((angle - turns * 1.57079632673412561417e+00) - turns * 6.07710050630396597660e-11) -
                     turns * 2.02226624879595063154e-21;
    const double z = x * x;
    double s = -7.6471637318198164759e-13 + z * 2.8114572543455207632e-15;
    s = 1.6059043836821614599e-10 + z * s;
    s = -2.5052108385441718775e-08 + z * s;
    s = 2.7557319223985890653e-06 + z * s;
    s = -1.9841269841269841270e-04 + z * s;
    s = 8.3333333333333333333e-03 + z * s;
    s = -1.6666666666666666667e-01 + z * s;
    s = x + x * (z * s);
    double c = 4.7794773323873852974e-14 + z * -1.5619206968586226462e-16;
    c = -1.1470745597729724714e-11 + z * c;
    c = 2.0876756987868098979e-09 + z * c;
    c = -2.7557319223985890653e-07 + z * c;
    c = 2.4801587301587301587e-05 + z * c;
    c = -1.3888888888888888889e-03 + z * c;
    c = 4.1666666666666666667e-02 + z * c;
    c = 1.0 - (0.5 * z - z * (z * c));
    const int64_t quarter = static_cast<int64_t>(turns) & 3;
    const double odd = (quarter & 1) ? c : s, even = (quarter & 1) ? s : c;
    return {(quarter & 2) ? -odd : odd, (quarter == 1 || quarter == 2) ? -even : even};
}

struct Vector {
    double x, y, z;
};

static inline Vector operator+(Vector a, Vector b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
static inline Vector operator-(Vector a, Vector b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
static inline Vector operator*(double k, Vector a) { return {k * a.x, k * a.y, k * a.z}; }
static inline double dot(Vector a, Vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline double squared(Vector a) { return dot(a, a); }
static inline Vector cross(Vector a, Vector b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
static inline Vector vector(const double* from) { return {from[0], from[1], from[2]}; }
static inline void write(Vector a, double* to) {
    to[0] = a.x;
    to[1] = a.y;
    to[2] = a.z;
}

// A rotation by its columns: the axes of a frame.
struct Rotation {
    Vector x, y, z;
};

static inline Rotation rotation(const double* rows) {
    return {{rows[0], rows[3], rows[6]}, {rows[1], rows[4], rows[7]}, {rows[2], rows[5], rows[8]}};
}
static inline Vector rotate(const Rotation& r, Vector a) {
    return {r.x.x * a.x + r.y.x * a.y + r.z.x * a.z, r.x.y * a.x + r.y.y * a.y + r.z.y * a.z,
            r.x.z * a.x + r.y.z * a.y + r.z.z * a.z};
}
static inline Vector rotate_back(const Rotation& r, Vector a) { return {dot(r.x, a), dot(r.y, a), dot(r.z, a)}; }
static inline Rotation operator*(const Rotation& r, const Rotation& s) {
    return {rotate(r, s.x), rotate(r, s.y), rotate(r, s.z)};
}

// Of the rotation from one frame to another: twice the vector part of its quaternion. Rounding hides the axis of a half
// turn; about any other one, a step leads out of it.
static inline Vector rotation_from(const Rotation& a, const Rotation& b) {
    const double trace = dot(a.x, b.x) + dot(a.y, b.y) + dot(a.z, b.z);
    if (1.0 + trace < 1e-12) return 2.0 * a.x;
    return (1.0 / sqrt(1.0 + trace)) * (cross(a.x, b.x) + cross(a.y, b.y) + cross(a.z, b.z));
}

// Rotation about a unit axis (Rodrigues).
static inline Rotation about(Vector axis, double angle) {
    const SineCosine t = sine_cosine(angle);
    const double c = t.cosine, s = t.sine, v = 1.0 - c;
    const Vector a = axis;
    return {{c + v * a.x * a.x, v * a.x * a.y + s * a.z, v * a.x * a.z - s * a.y},
            {v * a.x * a.y - s * a.z, c + v * a.y * a.y, v * a.y * a.z + s * a.x},
            {v * a.x * a.z + s * a.y, v * a.y * a.z - s * a.x, c + v * a.z * a.z}};
}
