// What the gate asks of distances.
#pragma once

#include "fields.hpp"

// Write the distance above the smallest legal one of every pair at a configuration (12,). Far pairs, which no window of
// targets brings together, may get a lower bound of it.
typedef void (*Measure)(const void* context, const double* q, double* spare);

#define DISTANCES(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                              \
    INT(pairs) REALS(levers, pairs * 12) FUNCTION(measure, Measure) LINK(context, void)

STRUCTURE(Distances, DISTANCES)
