// The safety gate's checks; see `dual_ur10.sim2real.control.gate`.
#pragma once

#include "measure.hpp"
#include "envelope.hpp"

namespace {

constexpr double TOLERANCE = 1.0 + 1e-9;   // rounding of a third difference of positions

// Reasons of a refusal.
enum Reason { NONE = 0, LIMIT = 1, CARTESIAN = 2, DISTANCE = 3 };

}  // namespace

#define GATE(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                                   \
    INT(n) INT(pairs) INT(brake_rows) INT(most_checks) LINK(envelope, Envelope) LINK(distances, Distances)             \
    REALS(brake, brake_rows * 3) REALS(past, n * 36) REALS(spare_m, n * pairs) REALS(known_m, n * pairs)               \
    REALS(away_rad, n * 12) INTS(reason, n) INTS(index, n) REALS(found, n) REALS(q_rad, n * 12) INT(ticks)              \
    REALS(targets, n * ticks * 12) REAL(sweep_tolerance_m)

STRUCTURE(Gate, GATE)

namespace {

// Distances along the path from the last target along the new ones to the end of the brake, as finely as needed.
//
// Most pairs are so far apart that no such path brings them too close; they need no further check.
struct Sweep {
    const Gate& gate;
    const Envelope& envelope;
    const Distances& distances;
    const double* window;
    double* found;  // (12,) configuration at which a pair is too close

    // What is not measured is NaN, which no check lets pass.
    void measure(const double* q, double* spare) const {
        for (int64_t pair = 0; pair < distances.pairs; ++pair) spare[pair] = NAN;
        distances.measure(distances.context, q, spare);
    }

    // Largest decrease of a pair's distance over joint travel (12,).
    double travel(int64_t pair, const double* path) const {
        const double* levers = distances.levers + pair * JOINTS;
        double sum = 0.0;
        for (int64_t j = 0; j < JOINTS; ++j) sum += levers[j] * path[j];
        return sum;
    }

    bool all_beyond(const double* spare, const double* path) const {
        for (int64_t pair = 0; pair < distances.pairs; ++pair)
            if (!(spare[pair] >= travel(pair, path))) return false;
        return true;
    }

    // Return true if no pair is too close. `first_order` is the end of a first-order decay from the last target: the
    // brake goes no further than there and back to `rest`, its end, where `spare` was measured.
    bool is_clear(int64_t row, const double* first_order, const double* rest, const double* spare) const {
        const int64_t pairs = distances.pairs;
        const double *end = window + (envelope.width - 1) * JOINTS;
        double *known = gate.known_m + row * pairs, *away = gate.away_rad + row * JOINTS;
        double coming[JOINTS] = {}, braking[JOINTS], whole[JOINTS];
        for (int64_t j = 0; j < JOINTS; ++j) {
            for (int64_t k = HISTORY; k < envelope.width; ++k)
                coming[j] += fabs(window[k * JOINTS + j] - window[(k - 1) * JOINTS + j]);
            braking[j] = fabs(first_order[j] - end[j]) + fabs(rest[j] - first_order[j]);
            whole[j] = coming[j] + braking[j];
        }
        if (all_beyond(spare, whole)) {
            copy(known, spare, pairs);
            copy(away, braking, JOINTS);
            return true;
        }
        const Scratch begin(pairs), there(pairs);
        for (int64_t pair = 0; pair < pairs; ++pair) begin[pair] = larger(known[pair] - travel(pair, away), 0.0);
        measure(end, there);
        copy(known, there, pairs);
        memset(away, 0, sizeof(double) * JOINTS);
        bool proven = true;
        for (int64_t pair = 0; pair < pairs; ++pair) {
            if (!(there[pair] >= 0.0)) {
                copy(found, end, JOINTS);
                return false;
            }
            proven &= begin[pair] + there[pair] - travel(pair, coming) >= -2.0 * gate.sweep_tolerance_m &&
                      there[pair] + spare[pair] - travel(pair, braking) >= -2.0 * gate.sweep_tolerance_m;
        }
        return proven || bisect(begin, there, spare);
    }

    // Check by bisection every part of the path that the bounds at its ends do not prove clear.
    bool bisect(const double* begin, const double* there, const double* rest) const {
        const int64_t ticks = envelope.ticks, length = 1 + ticks + gate.brake_rows;
        const Scratch path(length * JOINTS), gone(length * JOINTS);
        const double* end = window + (envelope.width - 1) * JOINTS;
        copy(path, window + (HISTORY - 1) * JOINTS, (1 + ticks) * JOINTS);
        double last[HISTORY * JOINTS];
        for (int64_t k = 0; k < HISTORY; ++k)
            for (int64_t j = 0; j < JOINTS; ++j)
                last[k * JOINTS + j] = window[(envelope.ticks + k) * JOINTS + j] - end[j];
        for (int64_t k = 0; k < gate.brake_rows; ++k) {
            double* here = path + (1 + ticks + k) * JOINTS;
            weighted(gate.brake + 3 * k, 0, HISTORY, last, here);
            for (int64_t j = 0; j < JOINTS; ++j) here[j] += end[j];
        }
        memset(gone, 0, sizeof(double) * JOINTS);
        for (int64_t i = JOINTS; i < length * JOINTS; ++i) gone[i] = gone[i - JOINTS] + fabs(path[i] - path[i - JOINTS]);
        int64_t checks = 0;
        return part(path, gone, ticks, there, length - 1, rest, checks) &&
               part(path, gone, 0, begin, ticks, there, checks);
    }

    // Every configuration between two has at least half of their spare distances, less the travel, to spare.
    bool part(const double* path, const double* gone, int64_t first, const double* spare_first, int64_t last,
              const double* spare_last, int64_t& checks) const {
        if (last - first < 2) return true;
        const int64_t pairs = distances.pairs;
        double moved[JOINTS];
        const Scratch least(pairs), spare(pairs);
        for (int64_t j = 0; j < JOINTS; ++j) moved[j] = gone[last * JOINTS + j] - gone[first * JOINTS + j];
        bool proven = true;
        for (int64_t pair = 0; pair < pairs; ++pair) {
            least[pair] = spare_first[pair] + spare_last[pair] - travel(pair, moved);
            proven &= least[pair] >= -2.0 * gate.sweep_tolerance_m;
        }
        if (proven) return true;
        const int64_t half = (first + last) / 2;
        measure(path + half * JOINTS, spare);
        bool clear = ++checks <= gate.most_checks;
        for (int64_t pair = 0; pair < pairs; ++pair) clear &= !(least[pair] < 0.0) || spare[pair] >= 0.0;
        if (!clear) {
            copy(found, path + half * JOINTS, JOINTS);
            return false;
        }
        return part(path, gone, half, spare, last, spare_last, checks) &&
               part(path, gone, first, spare_first, half, spare, checks);
    }
};

// Find out whether a window may be released, and keep the reason if not.
bool check(const Gate& g, int64_t row, const double* window, double* scratch) {
    const Envelope& e = *g.envelope;
    const Quantities quantities(e, window, scratch);
    double fraction[JOINTS], peak[JOINTS] = {}, worst = TOLERANCE;
    int64_t worst_index = -1;
    for (int64_t k = 0; k < e.m; ++k) {
        quantities.fraction(k, fraction);
        if (k < e.speed_rows) raise_peak(peak, fraction);
        if (all_within(fraction, TOLERANCE)) continue;
        for (int64_t j = 0; j < JOINTS; ++j) {
            const double used = fabs(fraction[j]) <= INFINITY ? fabs(fraction[j]) : INFINITY;  // NaN is the worst
            if (used <= worst) continue;
            worst = used;
            worst_index = k * JOINTS + j;
        }
    }
    double* q = g.q_rad + row * JOINTS;
    if (worst_index >= 0) {
        double value[JOINTS];
        quantities.value(worst_index / JOINTS, value);
        g.reason[row] = LIMIT;
        g.index[row] = worst_index;
        g.found[row] = value[worst_index % JOINTS];
        return false;
    }
    if (!(cartesian_bound(e, peak) <= 1.0)) {
        Fastest best[2];
        cartesian_use(e, window, TOLERANCE, best);
        const double second = best[1].fraction;
        const Fastest& fastest = best[best[0].fraction <= second || second != second];
        if (!(fastest.fraction <= TOLERANCE)) {
            g.reason[row] = CARTESIAN;
            g.index[row] = 3 * fastest.arm + fastest.point;
            g.found[row] = fastest.fraction;
            return false;
        }
    }
    double first_order[JOINTS], rest[JOINTS];
    quantities.value(e.m - 2, first_order);
    quantities.value(e.m - 1, rest);
    const Sweep sweep = {g, e, *g.distances, window, q};
    double* spare = g.spare_m + row * g.pairs;
    sweep.measure(rest, spare);
    bool clear = true;
    for (int64_t pair = 0; pair < g.pairs; ++pair) clear &= spare[pair] >= 0.0;
    if (!clear) copy(q, rest, JOINTS);
    if (clear && sweep.is_clear(row, first_order, rest, spare)) return true;
    g.reason[row] = DISTANCE;
    return false;
}

// Continue with the brake, or stay where the arms are at rest.
void brake(const Gate& g, double* window) {
    const Envelope& e = *g.envelope;
    const double* last = window + (HISTORY - 1) * JOINTS;
    double past[HISTORY * JOINTS], fastest = 0.0;
    for (int64_t k = 0; k < HISTORY; ++k)
        for (int64_t j = 0; j < JOINTS; ++j) {
            past[k * JOINTS + j] = window[k * JOINTS + j] - last[j];
            if (k > 0) fastest = larger(fastest, fabs(window[k * JOINTS + j] - window[(k - 1) * JOINTS + j]));
        }
    const bool resting = fastest / e.tick_s < e.rest_speed_rad_s;
    for (int64_t k = 0; k < e.ticks; ++k) {
        double* target = window + (HISTORY + k) * JOINTS;
        weighted(e.brake + 3 * k, 0, HISTORY, past, target);
        for (int64_t j = 0; j < JOINTS; ++j) target[j] = resting ? last[j] : target[j] + last[j];
    }
}

}  // namespace

// Release the targets, (n, ticks, 12), of rows `first` to `last`, or replace them by the brake.
EXPORT void gate_step(const Gate* g, int64_t first, int64_t last) {
    const Envelope& e = *g->envelope;
    const int64_t count = e.ticks * JOINTS;
    const Scratch window(e.width * JOINTS), scratch(e.width * JOINTS);
    for (int64_t row = first; row < last; ++row) {
        double *past = g->past + row * HISTORY * JOINTS, *wanted = g->targets + row * count;
        copy(window, past, HISTORY * JOINTS);
        copy(window + HISTORY * JOINTS, wanted, count);
        if (g->reason[row] != NONE || !check(*g, row, window, scratch)) brake(*g, window);
        copy(past, window + e.ticks * JOINTS, HISTORY * JOINTS);
        copy(wanted, window + HISTORY * JOINTS, count);
    }
}
