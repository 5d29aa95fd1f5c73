// Distances of the collision model; see `dual_ur10.sim2real.control.clearance`.
#pragma once

#include "measure.hpp"

#include "distances.hpp"

#define CLEARANCE(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                              \
    INT(geoms) INT(pairs) REAL(cutoff_m) INTS(parent, 13) REALS(offset_m, 39)                  \
    REALS(turned, 117) REALS(axis, 39) INTS(body, geoms) INTS(shape, geoms) REALS(center_m, geoms * 3)  \
    REALS(axes, geoms * 9) REALS(size_m, geoms * 3) REALS(radius_m, geoms) REALS(base_m, geoms * 3)                    \
    INTS(first, pairs) INTS(second, pairs) REALS(known_m, pairs) REALS(granted_m, pairs) REALS(shift_m, pairs)         \
    REALS(first_rad, pairs) REALS(second_rad, pairs)

STRUCTURE(Clearance, CLEARANCE)

namespace {

// All geoms of a cell, in the cell frame.
struct Placed {
    Scratch memory;

    explicit Placed(int64_t geoms) : memory(geoms * static_cast<int64_t>(sizeof(Body) / sizeof(double))) {}
    operator Body*() const { return reinterpret_cast<Body*>(memory.data); }
};

// Frames of all bodies: body k > 0 turns with joint k - 1, body 0 is the world.
struct Chain {
    Vector positions[JOINTS + 1];
    Rotation turned[JOINTS + 1];
};

// Poses of all bodies and geoms at a configuration.
void place(const Clearance& c, const double* q, Body* placed, Chain& chain) {
    Vector* positions = chain.positions;
    Rotation* turned = chain.turned;
    positions[0] = {0.0, 0.0, 0.0};
    turned[0] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
    for (int64_t k = 1; k <= JOINTS; ++k) {
        const int64_t parent = c.parent[k];
        positions[k] = positions[parent] + rotate(turned[parent], vector(c.offset_m + 3 * k));
        turned[k] = turned[parent] * (rotation(c.turned + 9 * k) * about(vector(c.axis + 3 * k), q[k - 1]));
    }
    for (int64_t k = 0; k < c.geoms; ++k) {
        const Rotation& frame = turned[c.body[k]];
        Body& body = placed[k];
        body.shape = static_cast<Shape>(c.shape[k]);
        body.center = positions[c.body[k]] + rotate(frame, vector(c.center_m + 3 * k));
        body.axes = frame * rotation(c.axes + 9 * k);
        copy(body.size, c.size_m + 3 * k, 3);
        body.radius = c.radius_m[k];
    }
}

void place(const Clearance& c, const double* q, Body* placed) {
    Chain chain;
    place(c, q, placed, chain);
}

// Distance from the arm's base within which all of a geom lies.
double reach(const Clearance& c, const Body* placed, int64_t geom) {
    return sqrt(squared(placed[geom].center - vector(c.base_m + 3 * geom))) + placed[geom].radius;
}

// Smallest legal distance of a pair, with the uncertainty of the base poses.
double allowed(const Clearance& c, const Body* placed, int64_t pair) {
    double result = c.known_m[pair] + c.shift_m[pair];
    if (c.first_rad[pair] != 0.0) result += c.first_rad[pair] * reach(c, placed, c.first[pair]);
    if (c.second_rad[pair] != 0.0) result += c.second_rad[pair] * reach(c, placed, c.second[pair]);
    return result;
}

double measured(const Clearance& c, const Body* placed, int64_t pair) {
    const Body &a = placed[c.first[pair]], &b = placed[c.second[pair]];
    const double bound = distance_of_spheres(a, b);
    return bound >= c.cutoff_m ? bound : distance(a, b);
}

double spare_of(const Clearance& c, const Body* placed, int64_t pair) {
    return measured(c, placed, pair) + c.granted_m[pair] - allowed(c, placed, pair);
}

// Rotate a geom about the axis of a joint, if that moves it.
void turn(const Clearance& c, const Chain& chain, int64_t joint, double angle, int64_t geom, Body* placed) {
    int64_t body = c.body[geom];
    while (body > joint + 1) body = c.parent[body];
    if (body != joint + 1) return;
    const Vector at = chain.positions[body];
    const Rotation by = about(rotate(chain.turned[body], vector(c.axis + 3 * body)), angle);
    placed[geom].center = at + rotate(by, placed[geom].center - at);
    placed[geom].axes = by * placed[geom].axes;
}

}  // namespace

// Distances above the smallest legal ones, (pairs,), at a configuration (12,); beyond the cutoff a lower bound.
SIZES(clearance_spare, "- 12 $0.pairs")
EXPORT void clearance_spare(const void* context, const double* q, double* spare) {
    const Clearance& c = *static_cast<const Clearance*>(context);
    const Placed placed(c.geoms);
    place(c, q, placed);
    for (int64_t pair = 0; pair < c.pairs; ++pair)
        spare[pair] = spare_of(c, placed, pair);
}

// Slopes of a pair's spare distance; see `Slopes`. Only the two geoms are moved.
SIZES(clearance_slopes, "- 12 - 12")
EXPORT void clearance_slopes(const Distances* d, const double* q, int64_t pair, double* slopes) {
    const Clearance& c = *static_cast<const Clearance*>(d->context);
    const Placed memory(c.geoms);
    Body* placed = memory;
    Chain chain;
    place(c, q, placed, chain);
    const int64_t geoms[2] = {c.first[pair], c.second[pair]};
    const Body here[2] = {placed[geoms[0]], placed[geoms[1]]};
    const double spare = spare_of(c, placed, pair);
    for (int64_t j = 0; j < JOINTS; ++j) {
        slopes[j] = 0.0;
        if (d->levers[pair * JOINTS + j] == 0.0) continue;
        for (const int64_t geom : geoms) turn(c, chain, j, SLOPE_RAD, geom, placed);
        slopes[j] = (spare_of(c, placed, pair) - spare) / SLOPE_RAD;
        for (int k = 0; k < 2; ++k) placed[geoms[k]] = here[k];
    }
}

// Distances, those beyond the cutoff as the cutoff, and the smallest legal ones, (n, pairs), at (n, 12).
SIZES(clearance_distances, "- 12*$4 $0.pairs*$4 $0.pairs*$4 -")
EXPORT void clearance_distances(const Clearance* c, const double* q, double* distances, double* legal, int64_t n) {
    const Placed placed(c->geoms);
    for (int64_t row = 0; row < n; ++row) {
        place(*c, q + row * JOINTS, placed);
        for (int64_t pair = 0; pair < c->pairs; ++pair) {
            distances[row * c->pairs + pair] = smaller(measured(*c, placed, pair), c->cutoff_m);
            legal[row * c->pairs + pair] = allowed(*c, placed, pair);
        }
    }
}

// Proven fractions, (n, 2), of straight paths in joint space; see `dual_ur10.sim2real.control.planner`. Each row of `paths`
// is a first and a last configuration, (12,) each; `margin` and `tolerance` are distances in m of each pair.
//
// Up to the first fraction no pair comes nearer than its margin, or, where it began nearer, than it was before: at every
// measured configuration, and from one to the next within the tolerance. At the second one all pairs keep their margins.
SIZES(clear_fractions, "- 24*$5 $0.pairs $0.pairs 2*$5 -")
EXPORT void clear_fractions(const Distances* d, const double* paths, const double* margin, const double* tolerance,
                            double* fractions, int64_t n) {
    constexpr double rounding = 1e-6;
    const Scratch spare(d->pairs), least(d->pairs), travel(d->pairs);
    for (int64_t row = 0; row < n; ++row) {
        const double *from = paths + row * 2 * JOINTS, *to = from + JOINTS;
        double *clear = fractions + 2 * row, *kept = clear + 1;
        *clear = *kept = 0.0;
        for (int64_t pair = 0; pair < d->pairs; ++pair) {
            travel[pair] = 0.0;
            for (int64_t j = 0; j < JOINTS; ++j) travel[pair] += d->levers[pair * JOINTS + j] * fabs(to[j] - from[j]);
            least[pair] = -INFINITY;
        }
        for (double here = 0.0;;) {
            double q[JOINTS], step = 1.0;
            for (int64_t j = 0; j < JOINTS; ++j) q[j] = here < 1.0 ? from[j] + here * (to[j] - from[j]) : to[j];
            for (int64_t pair = 0; pair < d->pairs; ++pair) spare[pair] = NAN;  // what is not measured is not clear
            d->measure(d->context, q, spare);
            bool no_nearer = true, all_kept = true;
            for (int64_t pair = 0; pair < d->pairs; ++pair) {
                no_nearer &= spare[pair] >= least[pair] - rounding;
                all_kept &= spare[pair] >= margin[pair] - rounding;
                least[pair] = larger(least[pair], smaller(spare[pair], margin[pair]));
                const double room = spare[pair] - least[pair] + tolerance[pair];
                if (room < step * travel[pair]) step = room / travel[pair];
            }
            if (!no_nearer) break;
            *clear = here;
            if (all_kept) *kept = here;
            if (here >= 1.0) break;
            here = smaller(here + step, 1.0);
        }
    }
}
