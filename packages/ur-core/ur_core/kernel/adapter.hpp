// From actions to servoj targets; see `dual_ur10.sim2real.control.adapter`.
#pragma once

#include "stopping.hpp"

namespace {

constexpr double FULL = 1.0 - 1e-6;         // usable fraction of a limit: rounding stays away from the safety gate
constexpr double CARTESIAN_FULL = 0.993;    // the brake is sampled: the gate, with other samples, must not find more
constexpr double TINY = 1e-200;
constexpr int TRIES = 4;  // to find a fraction within the Cartesian speed limit, which is not linear

// Commands are smooth where their third difference is at most this fraction of the sum of the three first ones. A
// speed that begins at once has 1, then 1/2; a sine of 0.5 Hz at 25 Hz has 0.005. Where the third difference is below
// these sizes, it does no harm.
constexpr double SMOOTH = 0.15, ROUGH = 0.4, SMALL_RAD = 1e-5, LARGE_RAD = 4e-5;

// Steps that differ by less are the same: inverse kinematics repeats a command up to its rounding, and Cartesian motion at
// constant speed changes the joints' speeds by a small fraction.
constexpr double SAME_RAD = 1e-9, SAME = 0.02;
constexpr double AT_REST_RAD_S = 1e-4;  // below it, or this fraction of the commands' speed, a joint needs no stop
constexpr double AT_REST = 0.01;
constexpr int64_t LED = JOINTS;  // bit of `stops`: the last commands were led, and are not the policy's

// Rows of the state, and of the values that a plan is made of.
constexpr int64_t GOALS = 3, GOAL = 6, NOW = 7, ROWS = 11;
constexpr int64_t MEETING = 7, VALUES = 11;

enum Mode { STEP = 0, POSITION = 1, GOAL_GIVEN = 2 };

}  // namespace

#define ADAPTER(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                                \
    INT(n) INT(ticks) INT(width) INT(mode) INT(size) INT(latest) INT(between_rows) INT(later_rows) REAL(approach)      \
    LINK(envelope, Envelope) LINK(stopping, Stopping) REALS(plans, latest * ticks * 11) REALS(ends, latest * 44)       \
    REALS(lines, latest * 16) REALS(cubics, latest * 16) REALS(between, latest * between_rows * 11) INTS(later_ends, latest)                     \
    INTS(later_kinds, later_rows) REALS(later, later_rows * 11) REALS(limits, 36) INT(meetings)                        \
    INTS(periods, meetings) INTS(curved, meetings) REALS(pursuit, ticks * 11) REAL(pursuit_rate)                       \
    REALS(resume, 4 * width) REALS(joint_step, 12) REALS(lower, 12) REALS(upper, 12) REALS(leash, 12)                  \
    REALS(state, n * 132) REALS(before, n * 132) INTS(rest, n) INTS(stops, n) REALS(commanded, n * 12)                     \
    REALS(action, n * 2 * size) REALS(targets, n * ticks * 12)                                                         \
    REALS(widths_m, n * ticks * 2) REALS(most_m, 2) REALS(goal, n * 12) REALS(lowest, 2 * size) REALS(highest, 2 * size)   \
    INTS(clipped, n) REALS(links, 156) REALS(tool_m, 2) REAL(turn_m)

STRUCTURE(Adapter, ADAPTER)

namespace {

// Continue three past targets by rows (ticks, 3): coasting, or the brake.
void follow(const Envelope& e, const double* rows, double* window) {
    double past[HISTORY * JOINTS];
    const double* last = window + (HISTORY - 1) * JOINTS;
    double* targets = window + HISTORY * JOINTS;
    for (int64_t k = 0; k < HISTORY; ++k)
        for (int64_t j = 0; j < JOINTS; ++j) past[k * JOINTS + j] = window[k * JOINTS + j] - last[j];
    multiply(rows, e.ticks, HISTORY, past, targets);
    for (int64_t k = 0; k < e.ticks; ++k)
        for (int64_t j = 0; j < JOINTS; ++j) targets[k * JOINTS + j] += last[j];
}

// Lead the targets of a legal window as far towards planned ones as the limits allow.
void depart(const Envelope& e, const double* planned, double* window) {
    const int64_t count = e.ticks * JOINTS;
    const Scratch scratch(e.width * JOINTS), wanted_scratch(e.width * JOINTS), base(count);
    double* targets = window + HISTORY * JOINTS;
    copy(base, targets, count);
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

// The legal window nearest to a planned one that breaks a limit.
//
// It is coasting, at the speed it has, plus a fraction of the step from there to the planned targets. Every limit is
// linear in the fraction, so the largest legal one is a minimum over ratios. One fraction for all twelve joints keeps
// the direction of the step, and with it the relative pose of two arms. Where coasting itself would exceed a limit, the
// brake takes its place, which the last period left possible: a fraction of zero is always legal.
void limit(const Envelope& e, const double* planned, double* window) {
    const Scratch scratch(e.width * JOINTS);
    follow(e, e.coast, window);
    if (!is_legal(e, window, scratch, FULL, CARTESIAN_FULL)) follow(e, e.brake, window);
    depart(e, planned, window);
}

// Of twelve joints, 1 where the commands, (4, 12), are smooth, 0 where they are not. Returns true if any is above 0.
bool smoothness(const double* goals, double* weight) {
    double any = 0.0;
    for (int64_t j = 0; j < JOINTS; ++j) {
        const double a = goals[JOINTS + j] - goals[j], b = goals[2 * JOINTS + j] - goals[JOINTS + j];
        const double c = goals[3 * JOINTS + j] - goals[2 * JOINTS + j];
        const double third = fabs((c - b) - (b - a)), ratio = third / larger(fabs(a) + fabs(b) + fabs(c), TINY);
        const double relative = (ROUGH - ratio) / (ROUGH - SMOOTH);
        weight[j] = clamp(larger(relative, (LARGE_RAD - third) / (LARGE_RAD - SMALL_RAD)), 0.0, 1.0);
        any = larger(any, weight[j]);
    }
    return any > 0.0;
}

// The path's position, speed, acceleration and jerk, (4, 12), after targets that are not those of a plan.
void resume(const Adapter& a, const double* state, const double* window, double* end) {
    const int64_t width = a.envelope->width;
    const double* last = state + (HISTORY - 1) * JOINTS;
    const Scratch known(a.width * JOINTS);
    copy(known, window, width * JOINTS);
    copy(known + width * JOINTS, state + NOW * JOINTS, 2 * JOINTS);  // position and speed of the path
    // Relative to the last target: joints that rest do so to the last bit.
    for (int64_t i = 0; i < (width + 1) * JOINTS; ++i) known[i] -= last[i % JOINTS];
    multiply(a.resume, 4, a.width, known, end);
    for (int64_t j = 0; j < JOINTS; ++j) end[j] += last[j];
}

// Line through the last two commands of a joint.
struct Line {
    const Stopping& s;
    double at, speed;             // now, and per second
    bool stands, goes_on, is_old; // has no speed; has that of a period ago; that one had its own a period before

    Line(const Stopping& stopping, const double* goals, int64_t j) : s(stopping), at(goals[2 * JOINTS + j]) {
        const double last = goals[3 * JOINTS + j] - at, before = at - goals[JOINTS + j], first = goals[JOINTS + j] - goals[j];
        speed = last / s.period_s;
        stands = fabs(last) <= SAME_RAD;
        goes_on = same(last, before);
        is_old = same(before, first);
    }

    // Target with which an arm stays on the line.
    double target(int64_t tick) const {
        return at + speed * (s.lead_s + s.lookahead_s + static_cast<double>(tick) * s.tick_s);
    }

  private:
    static bool same(double a, double b) { return fabs(a - b) <= SAME_RAD + SAME * larger(fabs(a), fabs(b)); }
};

// Plan the soonest stop beside their line of the joints that are faster than it and cannot but pass it. Returns these
// joints; `before` are those that already stop.
//
// Such is a joint whose command stands still now, and one of an arm whose commands were lines that turned. Where every
// command is another line, as those of a policy that explores, the next one calls the arm back: to brake for each costs
// more than it gains.
int64_t plan_stop(const Stopping& s, const double* state, const double* smooth, int64_t before, Stop& stop) {
    const double *goals = state + GOALS * JOINTS, *now = state + NOW * JOINTS;
    bool lines[2] = {!has(before, LED), !has(before, LED)};
    for (int64_t j = 0; j < JOINTS; ++j) lines[j / 6] &= Line(s, goals, j).is_old;
    double begin[CARRIED * JOINTS] = {};
    int64_t stops = 0;
    for (int64_t j = 0; j < JOINTS; ++j) {
        const Line line(s, goals, j);
        const double speed = now[JOINTS + j], faster = speed - line.speed, ahead = now[j] - line.at;
        if (has(before, j)) {
            if (!line.goes_on) continue;
        } else {
            // On the way to a line that goes on, a path to a meeting is left alone.
            if (line.goes_on || !(line.stands || lines[j / 6]) || smooth[j] == 1.0) continue;
            const double least = ahead + faster * (s.lookahead_s + fabs(faster) / s.acceleration_rad_s2);
            if (faster * speed <= 0.0 || fabs(faster) <= AT_REST_RAD_S || least * faster <= 0.0) continue;
        }
        stops |= int64_t{1} << j;
        for (int64_t k = 0; k < HISTORY; ++k) begin[k * JOINTS + j] = state[k * JOINTS + j] - line.target(k - HISTORY);
        begin[3 * JOINTS + j] = ahead;
        begin[4 * JOINTS + j] = faster;
    }
    while (stops && stop.soonest(begin, FULL - 1e-6)) {  // within it, however it is rounded
        int64_t past = stops;
        for (int64_t j = 0; j < JOINTS; ++j) {
            if (!has(stops, j) || has(before, j) || stop.end[j] * begin[4 * JOINTS + j] > 0.0) continue;
            past &= ~(int64_t{1} << j);
            for (int64_t k = 0; k < CARRIED; ++k) begin[k * JOINTS + j] = 0.0;
        }
        if (past == stops) return stops;
        stops = past;
    }
    return 0;
}

// Plan of a period, with a meeting some periods from now.
struct Plan {
    const Adapter& a;
    const double *state, *goals, *last;  // (11, 12), (4, 12), (12,)
    double weight[JOINTS], values[VALUES * JOINTS];
    const bool smooth;
    Stop stop;
    const int64_t stops;  // joints that stop, wherever that is: they meet nothing
    int64_t unfinished;   // those whose stop takes longer than the period

    Plan(const Adapter& adapter, int64_t row)
        : a(adapter), state(a.state + row * ROWS * JOINTS), goals(state + GOALS * JOINTS), last(state + 2 * JOINTS),
          smooth(smoothness(goals, weight)), stop(*a.stopping),
          stops(plan_stop(*a.stopping, state, weight, a.stops[row], stop)), unfinished(stops) {
        // Relative to the last target: the terms of differences are small then, and so is their rounding.
        for (int64_t k = 0; k < MEETING; ++k) {
            const int64_t from = k < HISTORY ? k : k - HISTORY + NOW;
            const bool position = k <= HISTORY;
            for (int64_t j = 0; j < JOINTS; ++j)
                values[k * JOINTS + j] = has(stops, j) ? 0.0 : state[from * JOINTS + j] - (position ? last[j] : 0.0);
        }
    }

    void meet(int64_t periods, bool curved) {
        double relative[4 * JOINTS], line[4 * JOINTS], cubic[4 * JOINTS];
        for (int64_t i = 0; i < 4 * JOINTS; ++i) relative[i] = goals[i] - last[i % JOINTS];
        multiply(a.lines + 16 * (periods - 1), 4, 4, relative, line);
        multiply(a.cubics + 16 * (periods - 1), 4, 4, relative, cubic);
        for (int64_t j = 0; j < JOINTS; ++j) {
            // A cubic that no arm could follow does not predict the commands.
            const bool possible = periods == 1 || (fabs(cubic[JOINTS + j]) <= a.limits[j] &&
                                                   fabs(cubic[2 * JOINTS + j]) <= a.limits[JOINTS + j]);
            const double share = curved && possible ? weight[j] : 0.0;
            for (int64_t order = 0; order < 4; ++order) {
                const int64_t i = order * JOINTS + j;
                values[MEETING * JOINTS + i] = has(stops, j) ? 0.0 : line[i] + share * (cubic[i] - line[i]);
            }
        }
    }

    // Targets of arms that are too far from their commands, or too fast, for any meeting: towards the commands' speed,
    // and faster in proportion to the distance, so that half the acceleration suffices to arrive.
    void pursue(double* out) {
        meet(1, false);
        for (int64_t j = 0; j < JOINTS; ++j) {
            if (has(stops, j)) continue;
            const double distance = goals[2 * JOINTS + j] - last[j] - values[HISTORY * JOINTS + j];
            values[(MEETING + 1) * JOINTS + j] += a.pursuit_rate * distance;
        }
        targets(a.pursuit, out);
    }

    void targets(const double* matrix, double* out) const {
        multiply(matrix, a.ticks, VALUES, values, out);
        for (int64_t i = 0; i < a.ticks * JOINTS; ++i) out[i] += last[i % JOINTS];
        for (int64_t j = 0; stops && j < JOINTS; ++j) {
            const Line line(*a.stopping, goals, j);
            for (int64_t k = 0; has(stops, j) && k < a.ticks; ++k)
                out[k * JOINTS + j] = line.target(k) + stop.targets[k * JOINTS + j];
        }
    }

    // With few targets per period, legal targets can lie on an illegal path.
    bool legal_between(int64_t periods) const {
        double value[JOINTS];
        for (int64_t row = (periods - 1) * a.between_rows; row < periods * a.between_rows; ++row) {
            weighted(a.between + row * VALUES, 0, VALUES, values, value);
            if (!all_within(value, a.limits[JOINTS])) return false;
        }
        return true;
    }

    // True if the later periods, too, are legal until the arms are on the commands' continuation.
    bool legal_later(int64_t periods) const {
        double value[JOINTS];
        for (int64_t row = periods == 1 ? 0 : a.later_ends[periods - 2]; row < a.later_ends[periods - 1]; ++row) {
            weighted(a.later + row * VALUES, 0, VALUES, values, value);
            const double* limit = a.limits + a.later_kinds[row] * JOINTS;
            for (int64_t j = 0; j < JOINTS; ++j)
                if (!(fabs(value[j]) <= FULL * limit[j])) return false;
        }
        return true;
    }

    // Write the targets to the window, and the path's position, speed, acceleration and jerk after the period to `end`,
    // (4, 12), if all is legal with this meeting.
    bool legal(int64_t periods, bool curved, double* window, double* scratch, double* end) {
        if (curved && periods > 1 && !smooth) return false;  // the line's
        meet(periods, curved);
        if (!legal_later(periods) || !legal_between(periods)) return false;
        targets(a.plans + (periods - 1) * a.ticks * VALUES, window + HISTORY * JOINTS);
        if (!is_legal(*a.envelope, window, scratch, FULL, CARTESIAN_FULL)) return false;
        multiply(a.ends + (periods - 1) * 4 * VALUES, 4, VALUES, values, end);
        for (int64_t j = 0; j < JOINTS; ++j) end[j] += last[j];
        if (stops) finish(window, end);
        return true;
    }

    // Write where joints that stop are after the period.
    void finish(const double* window, double* end) {
        const double *newest = window + (a.ticks + HISTORY - 1) * JOINTS, tick_s = a.envelope->tick_s;
        double reached[4 * JOINTS];
        resume(a, state, window, reached);
        unfinished = 0;
        for (int64_t j = 0; j < JOINTS; ++j) {
            if (!has(stops, j)) continue;
            const double speed = Line(*a.stopping, goals, j).speed, least = tick_s * (AT_REST_RAD_S + AT_REST * fabs(speed));
            const double one = newest[j] - newest[j - JOINTS], two = newest[j - JOINTS] - newest[j - 2 * JOINTS];
            const bool over = stop.over() || (fabs(one - speed * tick_s) <= least && fabs(two - speed * tick_s) <= least);
            // At rest beside its line, an arm does not go on as its last targets did.
            for (int64_t order = 0; order < 4; ++order)
                end[order * JOINTS + j] = over && order > 1 ? 0.0 : reached[order * JOINTS + j];
            if (!over) unfinished |= int64_t{1} << j;
        }
    }
};

// Take a window as the targets of a row, and the end of its path as the state from which the next period continues.
void keep(const Adapter& a, int64_t row, const double* window, const double* end) {
    const int64_t ticks = a.ticks;
    double *state = a.state + row * ROWS * JOINTS, *commanded = a.commanded + row * JOINTS;
    double *goal = state + GOAL * JOINTS, *now = state + NOW * JOINTS;
    memmove(state + GOALS * JOINTS, state + (GOALS + 1) * JOINTS, sizeof(double) * (GOAL - GOALS) * JOINTS);
    copy(now, end, 4 * JOINTS);
    copy(state, window + ticks * JOINTS, HISTORY * JOINTS);
    for (int64_t j = 0; j < JOINTS; ++j) commanded[j] = clamp(goal[j], now[j] - a.leash[j], now[j] + a.leash[j]);
    copy(a.targets + row * ticks * JOINTS, window + HISTORY * JOINTS, ticks * JOINTS);
}

// False for a row whose action is no number somewhere: no motion is asked of either arm then. A bound would be worse, since
// NaN is clamped to one.
bool is_finite(const Adapter& a, int64_t row, const double* action) {
    bool finite = true;
    for (int64_t k = 0; k < 2 * a.size; ++k) finite &= isfinite(action[k]);
    for (int64_t j = 0; a.mode == GOAL_GIVEN && j < JOINTS; ++j) finite &= isfinite(a.goal[row * JOINTS + j]);
    return finite;
}

void step(const Adapter& a, int64_t row, const double* action) {
    const Envelope& e = *a.envelope;
    double *state = a.state + row * ROWS * JOINTS, *goal = state + GOAL * JOINTS;
    const double* commanded = a.commanded + row * JOINTS;
    bool clipped = false;
    for (int64_t k = 0; k < 2 * a.size; ++k) clipped |= action[k] < a.lowest[k] || action[k] > a.highest[k];
    a.clipped[row] += clipped;
    const bool whole = is_finite(a, row, action);
    for (int64_t j = 0; j < JOINTS; ++j) {
        const double value = a.mode == GOAL_GIVEN ? a.goal[row * JOINTS + j] : action[(j / 6) * a.size + j % 6];
        const double to = a.mode == STEP ? commanded[j] + clamp(value, -1.0, 1.0) * a.joint_step[j] : value;
        const double aim = whole ? to : commanded[j];
        const double here = (1.0 - a.approach) * goal[j - JOINTS];  // the last goal
        goal[j] = clamp(aim, here + a.lower[j], here + a.upper[j]);
    }
    copy(a.before + row * ROWS * JOINTS, state, ROWS * JOINTS);
    const Scratch window(e.width * JOINTS), scratch(e.width * JOINTS);
    double end[4 * JOINTS];
    copy(window, state, HISTORY * JOINTS);
    Plan plan(a, row);
    // The soonest legal meeting. The rest of the last path is among them: without it, arms would catch up later and
    // later, until they are too fast to do so.
    int64_t rest = a.rest[row] / 2, periods = 0, curved = a.rest[row] % 2;
    for (int64_t k = 0; k < a.meetings && !periods; ++k) {
        if (a.curved[k] == curved && 0 < rest && rest < a.periods[k]) {
            if (plan.legal(rest, curved, window, scratch, end)) periods = rest;
            rest = 0;
        }
        if (!periods && plan.legal(a.periods[k], a.curved[k], window, scratch, end)) {
            periods = a.periods[k];
            curved = a.curved[k];
        }
    }
    a.rest[row] = periods > 1 ? 2 * (periods - 1) + curved : 0;
    if (!periods) {
        const Scratch planned(e.width * JOINTS);
        copy(planned, window, e.width * JOINTS);
        plan.pursue(planned + HISTORY * JOINTS);
        limit(e, planned, window);
        resume(a, state, window, end);
    }
    a.stops[row] = plan.unfinished;
    keep(a, row, window, end);
}

}  // namespace

// Plan the targets, (n, ticks, 12), of rows `first` to `last` from the actions, (n, 2, size), and the widths of grippers,
// (n, ticks, 2), from their seventh number: -1 is closed, 1 is open.
EXPORT void adapter_step(const Adapter* a, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) {
        const double* action = a->action + row * 2 * a->size;
        step(*a, row, action);
        if (a->size < 7 || !is_finite(*a, row, action)) continue;  // grippers keep their widths
        for (int64_t k = 0; k < 2 * a->ticks; ++k)
            a->widths_m[row * 2 * a->ticks + k] = (clamp(action[6 + 7 * (k & 1)], -1.0, 1.0) + 1.0) * (a->most_m[k & 1] / 2.0);
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
