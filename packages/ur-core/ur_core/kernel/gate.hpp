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
    REALS(away_rad, n * 12) REALS(next_known_m, n * pairs) REALS(next_away_rad, n * 12) INTS(reason, n) INTS(index, n)  \
    REALS(found, n) REALS(q_rad, n * 12) INT(ticks) REALS(targets, n * ticks * 12) REALS(asked, n * ticks * 12)         \
    INTS(passed, n) REAL(sweep_tolerance_m)

STRUCTURE(Gate, GATE)

namespace {

// Why a window may not be released: the row and joint, or arm and point, of the worst limit with the value found, or the
// configuration at which a pair is too close.
struct Finding {
    Reason reason = NONE;
    int64_t index = 0;
    double found = 0.0, q[JOINTS] = {};
};

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
        const double *known = gate.known_m + row * pairs, *away = gate.away_rad + row * JOINTS;
        double *next_known = gate.next_known_m + row * pairs, *next_away = gate.next_away_rad + row * JOINTS;
        double coming[JOINTS] = {}, braking[JOINTS], whole[JOINTS];
        for (int64_t j = 0; j < JOINTS; ++j) {
            for (int64_t k = HISTORY; k < envelope.width; ++k)
                coming[j] += fabs(window[k * JOINTS + j] - window[(k - 1) * JOINTS + j]);
            braking[j] = fabs(first_order[j] - end[j]) + fabs(rest[j] - first_order[j]);
            whole[j] = coming[j] + braking[j];
        }
        if (all_beyond(spare, whole)) {
            copy(next_known, spare, pairs);
            copy(next_away, braking, JOINTS);
            return true;
        }
        const Scratch begin(pairs), there(pairs);
        for (int64_t pair = 0; pair < pairs; ++pair) begin[pair] = larger(known[pair] - travel(pair, away), 0.0);
        measure(end, there);
        copy(next_known, there, pairs);
        memset(next_away, 0, sizeof(double) * JOINTS);
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

// Find out whether a window may be released, and the reason if not. Nothing of the gate's own record changes.
bool check(const Gate& g, int64_t row, const double* window, double* scratch, Finding& finding) {
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
    if (worst_index >= 0) {
        double value[JOINTS];
        quantities.value(worst_index / JOINTS, value);
        finding.reason = LIMIT;
        finding.index = worst_index;
        finding.found = value[worst_index % JOINTS];
        return false;
    }
    if (!(cartesian_bound(e, peak) <= 1.0)) {
        Fastest best[2];
        cartesian_use(e, window, TOLERANCE, best);
        const double second = best[1].fraction;
        const Fastest& fastest = best[best[0].fraction <= second || second != second];
        if (!(fastest.fraction <= TOLERANCE)) {
            finding.reason = CARTESIAN;
            finding.index = 3 * fastest.arm + fastest.point;
            finding.found = fastest.fraction;
            return false;
        }
    }
    double first_order[JOINTS], rest[JOINTS];
    quantities.value(e.m - 2, first_order);
    quantities.value(e.m - 1, rest);
    const Sweep sweep = {g, e, *g.distances, window, finding.q};
    double* spare = g.spare_m + row * g.pairs;
    sweep.measure(rest, spare);
    bool clear = true;
    for (int64_t pair = 0; pair < g.pairs; ++pair) clear &= spare[pair] >= 0.0;
    if (!clear) copy(finding.q, rest, JOINTS);
    if (clear && sweep.is_clear(row, first_order, rest, spare)) return true;
    finding.reason = DISTANCE;
    return false;
}

// The same for who plans targets, before they are given to the gate. It remembers what passed, to the bit, and need not
// check that again.
bool ask(const Gate& g, int64_t row, const double* window, double* scratch, Finding& finding) {
    const int64_t count = g.ticks * JOINTS;
    finding.reason = NONE;
    g.passed[row] = check(g, row, window, scratch, finding);
    copy(g.asked + row * count, window + HISTORY * JOINTS, count);
    return g.passed[row];
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
        if (g->reason[row] == NONE) {
            const bool passed = g->passed[row] && !memcmp(g->asked + row * count, wanted, sizeof(double) * count);
            Finding finding;
            if (passed || check(*g, row, window, scratch, finding)) {
                copy(g->known_m + row * g->pairs, g->next_known_m + row * g->pairs, g->pairs);
                copy(g->away_rad + row * JOINTS, g->next_away_rad + row * JOINTS, JOINTS);
            } else {
                g->reason[row] = finding.reason;
                g->index[row] = finding.index;
                g->found[row] = finding.found;
                copy(g->q_rad + row * JOINTS, finding.q, JOINTS);
            }
        }
        g->passed[row] = 0;
        if (g->reason[row] != NONE) brake(*g, window);
        copy(past, window + e.ticks * JOINTS, HISTORY * JOINTS);
        copy(wanted, window + HISTORY * JOINTS, count);
    }
}
