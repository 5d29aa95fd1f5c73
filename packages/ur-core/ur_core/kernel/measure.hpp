// What the gate asks of distances.
#pragma once

#include "fields.hpp"
#include "numbers.hpp"

// Write the distance above the smallest legal one of every pair at a configuration (12,). Far pairs, which no window of
// targets brings together, may get a lower bound of it.
typedef void (*Measure)(const void* context, const double* q, double* spare);

struct Distances;

// Write the slopes of a pair's spare distance, in m per rad of each joint, (12,), at a configuration (12,).
typedef void (*Slopes)(const Distances* distances, const double* q, int64_t pair, double* slopes);

#define DISTANCES(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                              \
    INT(pairs) REALS(levers, pairs * 12) FUNCTION(measure, Measure)                    \
    FUNCTION(slopes, Slopes) LINK(context, void)

STRUCTURE(Distances, DISTANCES)

constexpr double SLOPE_RAD = 1e-6;  // step of finite differences: rounding and curvature are both below 1e-4 of a slope

// Slopes by finite differences of the measured distances, of all joints that have a lever.
SIZES(measured_slopes, "- 12 - 12")
EXPORT void measured_slopes(const Distances* d, const double* q, int64_t pair, double* slopes) {
    const Scratch here(d->pairs), there(d->pairs);
    double moved[JOINTS];
    d->measure(d->context, q, here);
    for (int64_t j = 0; j < JOINTS; ++j) {
        slopes[j] = 0.0;
        if (d->levers[pair * JOINTS + j] == 0.0) continue;
        copy(moved, q, JOINTS);
        moved[j] += SLOPE_RAD;
        d->measure(d->context, moved, there);
        slopes[j] = (there[pair] - here[pair]) / SLOPE_RAD;
    }
}
