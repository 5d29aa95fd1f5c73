// From actions to servoj targets; see `dual_ur10.sim2real.control.adapter`.
#pragma once

#include "envelope.hpp"

namespace {

constexpr double FULL = 1.0 - 1e-6;         // usable fraction of a limit: rounding stays away from the safety gate
constexpr double CARTESIAN_FULL = 0.993;    // the brake is sampled: the gate, with other samples, must not find more
constexpr double CONTINUATION = 1.0 + 1e-6;
constexpr double TINY = 1e-200;
constexpr int TRIES = 4;  // to find a fraction within the Cartesian speed limit, which is not linear

// Rows of the state.
constexpr int64_t GOALS = 3, GOAL = 6, NOW = 7, JERK = 10, VALUES = 11;

enum Mode { STEP = 0, POSITION = 1, GOAL_GIVEN = 2 };

}  // namespace

#define ADAPTER(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                                \
    INT(n) INT(ticks) INT(width) INT(mode) INT(size) INT(meetings) INT(between_rows) REAL(approach)                    \
    LINK(envelope, Envelope) REALS(plans, meetings * ticks * 11) REALS(ends, meetings * 44) INTS(cubic, meetings)      \
    REALS(continuations, meetings * 22) REALS(continuation_limits, 24) REALS(between, meetings * between_rows * 11)    \
    REAL(period_s) REAL(calm_jerk) REALS(resume, 4 * width)                                                                           \
    REALS(joint_step, 12) REALS(lower, 12) REALS(upper, 12) REALS(leash, 12)                                           \
    REALS(state, n * 132) REALS(commanded, n * 12) REALS(action, n * 2 * size) REALS(targets, n * ticks * 12)          \
    REALS(widths_m, n * ticks * 2) REAL(most_m) REALS(goal, n * 12) REALS(lowest, 2 * size) REALS(highest, 2 * size)   \
    INTS(clipped, n)

STRUCTURE(Adapter, ADAPTER)

namespace {

// Each of the rows of `matrix`, times the state, is within `limit` (rows, 12), or within 1 without one.
bool products_within(const double* matrix, int64_t rows, const double* state, const double* limit, double full) {
    double product[JOINTS];
    for (int64_t row = 0; row < rows; ++row) {
        weighted(matrix + row * VALUES, 0, VALUES, state, product);
        if (limit != nullptr)
            for (int64_t j = 0; j < JOINTS; ++j) product[j] /= limit[row * JOINTS + j];
        if (!all_within(product, full)) return false;
    }
    return true;
}

// The legal window nearest to a planned one that breaks a limit.
//
// It is coasting, at the speed it has, plus a fraction of the step from there to the planned targets. Every limit is
// linear in the fraction, so the largest legal one is a minimum over ratios. One fraction for all twelve joints keeps
// the direction of the step, and with it the relative pose of two arms. Where coasting itself would exceed a limit, the
// brake takes its place, which the last period left possible: a fraction of zero is always legal.
void limit(const Envelope& e, const double* planned, double* window) {
    const int64_t count = e.ticks * JOINTS;
    const Scratch scratch(e.width * JOINTS), wanted_scratch(e.width * JOINTS), base(count);
    double past[HISTORY * JOINTS];
    const double* last = window + (HISTORY - 1) * JOINTS;
    double* targets = window + HISTORY * JOINTS;
    for (int64_t k = 0; k < HISTORY; ++k)
        for (int64_t j = 0; j < JOINTS; ++j) past[k * JOINTS + j] = window[k * JOINTS + j] - last[j];
    const auto follow = [&](const double* rows) {
        multiply(rows, e.ticks, HISTORY, past, base);
        for (int64_t k = 0; k < e.ticks; ++k)
            for (int64_t j = 0; j < JOINTS; ++j) base[k * JOINTS + j] += last[j];
        copy(targets, base, count);
    };
    follow(e.coast);
    if (!is_legal(e, window, scratch, FULL, CARTESIAN_FULL)) follow(e.brake);
    const Quantities used(e, window, scratch), wanted(e, planned, wanted_scratch);
    double fraction = 1.0, now[JOINTS], then[JOINTS];
    const Scratch speed(e.speed_rows * JOINTS), gained(e.speed_rows * JOINTS);
    for (int64_t row = 0; row < e.m; ++row) {
        used.fraction(row, now);
        wanted.fraction(row, then);
        for (int64_t j = 0; j < JOINTS; ++j) {
            const double gain = then[j] - now[j];
            const double room = FULL - copysign(now[j], now[j] * gain);
            fraction = smaller(fraction, room / larger(fabs(gain), TINY));
            if (row < e.speed_rows) {
                speed[row * JOINTS + j] = now[j];
                gained[row * JOINTS + j] = gain;
            }
        }
    }
    fraction = larger(fraction, 0.0);
    const double* aim = planned + HISTORY * JOINTS;
    const auto take = [&] {
        for (int64_t i = 0; i < count; ++i) targets[i] = base[i] + fraction * (aim[i] - base[i]);
    };
    for (int attempt = 0; attempt < TRIES; ++attempt) {
        take();
        double peak[JOINTS] = {};
        for (int64_t i = 0; i < e.speed_rows * JOINTS; ++i)
            peak[i % JOINTS] = larger(peak[i % JOINTS], fabs(speed[i] + fraction * gained[i]));
        if (cartesian_bound(e, peak) <= CARTESIAN_FULL) return;
        const double fastest = cartesian_use(e, window, CARTESIAN_FULL);
        if (fastest <= CARTESIAN_FULL) return;
        fraction *= 0.9 / fastest;
    }
    fraction = 0.0;
    take();
}

void step(const Adapter& a, int64_t row, const double* action, double* targets) {
    const Envelope& e = *a.envelope;
    const int64_t ticks = a.ticks;
    double *state = a.state + row * VALUES * JOINTS, *commanded = a.commanded + row * JOINTS;
    double *goal = state + GOAL * JOINTS, *now = state + NOW * JOINTS;
    bool clipped = false;
    for (int64_t k = 0; k < 2 * a.size; ++k) clipped |= action[k] < a.lowest[k] || action[k] > a.highest[k];
    a.clipped[row] += clipped;
    for (int64_t j = 0; j < JOINTS; ++j) {
        const double value = a.mode == GOAL_GIVEN ? a.goal[row * JOINTS + j] : action[(j / 6) * a.size + j % 6];
        const double aim = a.mode == STEP ? commanded[j] + clamp(value, -1.0, 1.0) * a.joint_step[j] : value;
        const double here = (1.0 - a.approach) * now[j];
        goal[j] = clamp(aim, here + a.lower[j], here + a.upper[j]);
    }
    const Scratch window(e.width * JOINTS), scratch(e.width * JOINTS);
    double end[4 * JOINTS];
    copy(window, state, HISTORY * JOINTS);
    bool legal = false;
    for (int64_t k = 0; k < a.meetings && !legal; ++k) {
        multiply(a.plans + k * ticks * VALUES, ticks, VALUES, state, window + HISTORY * JOINTS);
        if (k > 0 && a.cubic[k] &&
            !products_within(a.continuations + k * 2 * VALUES, 2, state, a.continuation_limits, CONTINUATION))
            continue;
        if (!products_within(a.between + k * a.between_rows * VALUES, a.between_rows, state, nullptr, 1.0)) continue;
        legal = is_legal(e, window, scratch, FULL, CARTESIAN_FULL);
        if (legal) multiply(a.ends + k * 4 * VALUES, 4, VALUES, state, end);
    }
    if (!legal) {
        const Scratch planned(e.width * JOINTS), known(a.width * JOINTS);
        copy(planned, window, e.width * JOINTS);
        // A path that met its commands within a period may end with hundreds of rad/s³, which would lead centimetres off.
        // So more than a calm jerk continues only as far as it leads to the goal.
        double calm[VALUES * JOINTS];
        copy(calm, state, VALUES * JOINTS);
        const double t = a.period_s, reach = t * t * t / 6.0;
        for (int64_t j = 0; j < JOINTS; ++j) {
            const double jerk = state[JERK * JOINTS + j], little = clamp(jerk, -a.calm_jerk, a.calm_jerk);
            const double end_at = now[j] + t * (now[JOINTS + j] + t / 2.0 * now[2 * JOINTS + j]) + reach * little;
            const double missing = (goal[j] - end_at) / reach;
            calm[JERK * JOINTS + j] = little + clamp(jerk - little, smaller(missing, 0.0), larger(missing, 0.0));
        }
        multiply(a.plans + (a.meetings - 1) * ticks * VALUES, ticks, VALUES, calm, planned + HISTORY * JOINTS);
        limit(e, planned, window);
        copy(known, window, e.width * JOINTS);
        copy(known + e.width * JOINTS, now, 2 * JOINTS);  // position and speed of the path
        multiply(a.resume, 4, a.width, known, end);
    }
    memmove(state + GOALS * JOINTS, state + (GOALS + 1) * JOINTS, sizeof(double) * (GOAL - GOALS) * JOINTS);
    copy(now, end, 4 * JOINTS);
    copy(state, window + ticks * JOINTS, HISTORY * JOINTS);
    for (int64_t j = 0; j < JOINTS; ++j) commanded[j] = clamp(goal[j], now[j] - a.leash[j], now[j] + a.leash[j]);
    copy(targets, window + HISTORY * JOINTS, ticks * JOINTS);
}

}  // namespace

// Plan the targets, (n, ticks, 12), of rows `first` to `last` from the actions, (n, 2, size), and the widths of grippers,
// (n, ticks, 2), from their seventh number: -1 is closed, 1 is open.
EXPORT void adapter_step(const Adapter* a, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) {
        const double* action = a->action + row * 2 * a->size;
        step(*a, row, action, a->targets + row * a->ticks * JOINTS);
        for (int64_t k = 0; a->size == 7 && k < 2 * a->ticks; ++k)
            a->widths_m[row * 2 * a->ticks + k] = (clamp(action[6 + 7 * (k & 1)], -1.0, 1.0) + 1.0) * (a->most_m / 2.0);
    }
}

// Return the fastest point of each arm in windows (n, width, 12): fractions and points, (n, 2).
EXPORT void envelope_cartesian_use(const Envelope* e, const double* windows, double* fraction, double* point,
                                   int64_t n) {
    for (int64_t row = 0; row < n; ++row) {
        Fastest best[2];
        cartesian_use(*e, windows + row * e->width * JOINTS, 0.0, best);
        for (int64_t arm = 0; arm < 2; ++arm) {
            fraction[2 * row + arm] = best[arm].fraction;
            point[2 * row + arm] = static_cast<double>(best[arm].point);
        }
    }
}

// Scale planned windows (n, width, 12) down to the nearest legal ones, in place.
EXPORT void envelope_limit(const Envelope* e, double* windows, int64_t n) {
    const Scratch planned(e->width * JOINTS);
    for (int64_t row = 0; row < n; ++row) {
        copy(planned, windows + row * e->width * JOINTS, e->width * JOINTS);
        limit(*e, planned, windows + row * e->width * JOINTS);
    }
}
