// Motion led along what the safety gate would refuse; see `dual_ur10.sim2real.control.pipeline`.
#pragma once

#include "adapter.hpp"
#include "forward.hpp"
#include "gate.hpp"

#define LEAD(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                                   \
    INT(n) LINK(adapter, Adapter) LINK(gate, Gate) REAL(margin_m) INT(held) INTS(coupled, n) INTS(led, n)

STRUCTURE(Lead, LEAD)

namespace {

constexpr int CORRECTIONS = 6, HALVINGS = 3;  // windows that are tried before the brake: time is short
constexpr int MOST_WALLS = 16, SWEEPS = 20;
constexpr double LEAST_EFFECT = 0.1, DEEP_M = 0.002;
constexpr double LEAST_SHARE = 1e-3;
constexpr double DAMPING_M2 = 1e-4;  // near a singularity the joints count, too

// A pair that comes too close, as a linear bound on the displacement of the configuration at rest: slope · r >= least.
//
// A configuration on the way there moves by less than the one at rest. By how much shows when the pair is found again.
struct Wall {
    int64_t pair;
    bool at_rest;
    double slope[JOINTS], way[JOINTS], gain;  // gain: slope · way
    double least, push, spare, asked;

    // A distance is the least of several, to corners and edges: near the surface each of them is a wall of its own.
    bool is_replaced_by(int64_t other, bool rests) const {
        return pair == other && at_rest == rests && (!rests || spare < -DEEP_M);
    }
};

// How an arm gives way: the joint motion that costs least per effect is this times a slope. In an action mode of joints
// every joint counts alike. In one of tools the motion of the tool does, each in proportion to what was wanted of it: a
// translation is led by a translation, and does not turn the tool.
struct Mobility {
    double share = 0.0;  // each arm gives way in proportion to its own motion: one that rests does not move
    bool joints;
    double lower[36];  // Cholesky factor of the cost of joint motion

    // For the tool centre point at a distance before the flange, with rotations on a lever, and a wanted joint motion.
    void of_tool(const double* links, double tool_m, double turn_m, const double* q, const double* wanted) {
        Vector at, origin[6], axis[6];
        Rotation frame;
        flange(links, q, at, frame, origin, axis);
        at = at + tool_m * frame.z;
        double columns[6][6];
        Vector translation = {0.0, 0.0, 0.0}, rotation = {0.0, 0.0, 0.0};
        for (int k = 0; k < 6; ++k) {
            translation = translation + wanted[k] * cross(axis[k], at - origin[k]);
            rotation = rotation + wanted[k] * (turn_m * axis[k]);
        }
        const double moved = squared(translation), turned = squared(rotation), both = larger(moved + turned, TINY);
        const double cost = 1.0 / sqrt(larger(moved / both, LEAST_SHARE));
        const double turning = turn_m / sqrt(larger(turned / both, LEAST_SHARE));
        for (int k = 0; k < 6; ++k) {
            write(cost * cross(axis[k], at - origin[k]), columns[k]);
            write(turning * axis[k], columns[k] + 3);
        }
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j <= i; ++j) {
                double sum = i == j ? DAMPING_M2 : 0.0;
                for (int k = 0; k < 6; ++k) sum += columns[i][k] * columns[j][k];
                for (int k = 0; k < j; ++k) sum -= lower[6 * i + k] * lower[6 * j + k];
                lower[6 * i + j] = i == j ? sqrt(sum) : sum / lower[7 * j];
            }
    }

    void apply(const double* slope, double* way) const {
        copy(way, slope, 6);
        for (int i = 0; i < 6 && !joints; ++i) {
            for (int j = 0; j < i; ++j) way[i] -= lower[6 * i + j] * way[j];
            way[i] /= lower[7 * i];
        }
        for (int i = 5; i >= 0 && !joints; --i) {
            for (int j = i + 1; j < 6; ++j) way[i] -= lower[6 * j + i] * way[j];
            way[i] /= lower[7 * i];
        }
        for (int i = 0; i < 6; ++i) way[i] *= share;
    }
};

double product(const double* a, const double* b) {
    double sum = 0.0;
    for (int64_t j = 0; j < JOINTS; ++j) sum += a[j] * b[j];
    return sum;
}

// The walls that a motion meets, and the nearest motion that keeps all of them.
struct Walls {
    const Gate& gate;
    double margin_m;
    Mobility mobility[2];
    Wall walls[MOST_WALLS];
    int count = 0;

    // Add the pairs that are nearer than the margin at a configuration, which motion with the displacement `r` led to.
    bool add(const double* q, const double* r, bool at_rest, double* spare) {
        const Distances& d = *gate.distances;
        for (int64_t pair = 0; pair < d.pairs; ++pair) spare[pair] = NAN;
        d.measure(d.context, q, spare);
        bool found = false;
        for (int64_t pair = 0; pair < d.pairs; ++pair) {
            if (!(spare[pair] < margin_m)) continue;
            int at = 0;
            while (at < count && !walls[at].is_replaced_by(pair, at_rest)) ++at;
            if (at == MOST_WALLS) continue;
            Wall& wall = walls[at];
            const double effect = at == count || at_rest ? 1.0 : (spare[pair] - wall.spare) / wall.asked;
            d.slopes(&d, q, pair, wall.slope);
            for (int arm = 0; arm < 2; ++arm) mobility[arm].apply(wall.slope + 6 * arm, wall.way + 6 * arm);
            wall.gain = product(wall.slope, wall.way);
            if (!(wall.gain > TINY)) continue;
            wall.pair = pair;
            wall.at_rest = at_rest;
            wall.spare = spare[pair];
            wall.asked = (margin_m - spare[pair]) / clamp(effect, LEAST_EFFECT, 1.0);
            wall.least = wall.asked + product(wall.slope, r);
            count += at == count;
            found = true;
        }
        return found;
    }

    // The displacement nearest to a wanted one, by coordinate ascent on the walls' multipliers.
    void along(const double* wanted, double* r) {
        copy(r, wanted, JOINTS);
        for (int k = 0; k < count; ++k) walls[k].push = 0.0;
        for (int sweep = 0; sweep < SWEEPS; ++sweep) {
            bool changed = false;
            for (int k = 0; k < count; ++k) {
                Wall& wall = walls[k];
                const double push = larger(wall.push + (wall.least - product(wall.slope, r)) / wall.gain, 0.0);
                const double more = push - wall.push;
                if (more == 0.0) continue;
                for (int64_t j = 0; j < JOINTS; ++j) r[j] += more * wall.way[j];
                wall.push = push;
                changed = true;
            }
            if (!changed || count == 1) return;
        }
    }
};

struct Leading {
    const Adapter& a;
    const Gate& g;
    const Envelope& e;
    const int64_t row, size;
    const Scratch scratch, spare, base, planned, window, aim;
    double base_rest[JOINTS];
    Finding finding;

    Leading(const Lead& l, int64_t which)
        : a(*l.adapter), g(*l.gate), e(*l.adapter->envelope), row(which), size(e.width * JOINTS), scratch(size),
          spare(g.pairs), base(size), planned(size), window(size), aim(size) {
        copy(planned, g.past + row * HISTORY * JOINTS, HISTORY * JOINTS);
        copy(planned + HISTORY * JOINTS, a.targets + row * e.ticks * JOINTS, e.ticks * JOINTS);
        for (int64_t k = HISTORY; l.held >= 0 && k < e.width; ++k)
            copy(planned + k * JOINTS + 6 * l.held, planned + (HISTORY - 1) * JOINTS + 6 * l.held, 6);
    }

    bool passes(const double* which) { return ask(g, row, which, scratch, finding); }

    // Where the brake after a window ends.
    void rest(const double* which, double* q) const {
        const Envelope& own = *g.envelope;
        Quantities(own, which, scratch).value(own.m - 1, q);
    }

    void displacement(const double* which, double* r) const {
        rest(which, r);
        for (int64_t j = 0; j < JOINTS; ++j) r[j] -= base_rest[j];
    }

    // Write a window that the gate releases, and the goals that the policy is left with.
    bool find(const Lead& l, const double* before, double* goal) {
        const int64_t count = e.ticks * JOINTS;
        const double* last_goal = before + (GOAL - 1) * JOINTS;
        double wanted[JOINTS], r[JOINTS];
        copy(base, planned, HISTORY * JOINTS);
        follow(e, e.brake, base);
        rest(base, base_rest);
        displacement(planned, wanted);
        copy(window, planned, size);
        const double length2 = product(wanted, wanted);
        Walls walls = {g, l.margin_m, {}, {}};
        for (int arm = 0; arm < 2; ++arm) {
            Mobility& mobility = walls.mobility[arm];
            for (int j = 6 * arm; j < 6 * arm + 6; ++j) mobility.share += wanted[j] * wanted[j] / larger(length2, TINY);
            mobility.joints = a.mode != GOAL_GIVEN;
            if (!mobility.joints) mobility.of_tool(a.links + 78 * arm, a.tool_m[arm], a.turn_m, base_rest + 6 * arm, wanted + 6 * arm);
        }
        const bool leads = !l.coupled[row] && length2 > 1e-18;
        copy(r, wanted, JOINTS);
        for (int k = 0; leads && k < CORRECTIONS && finding.reason == DISTANCE; ++k) {
            double end[JOINTS];
            rest(window, end);
            if (!walls.add(finding.q, r, !memcmp(end, finding.q, sizeof(end)), spare)) break;
            walls.along(wanted, r);
            for (int64_t i = 0; i < count; i += JOINTS) {
                const double *of_base = base + HISTORY * JOINTS + i, *of_plan = planned + HISTORY * JOINTS + i;
                double step[JOINTS];
                for (int64_t j = 0; j < JOINTS; ++j) step[j] = of_plan[j] - of_base[j];
                const double share = product(step, wanted) / length2;
                double* to = aim + HISTORY * JOINTS + i;
                for (int64_t j = 0; j < JOINTS; ++j) to[j] = of_base[j] + step[j] + share * (r[j] - wanted[j]);
            }
            copy(aim, planned, HISTORY * JOINTS);
            copy(window, base, size);
            depart(e, aim, window);
            if (passes(window)) {
                shift(walls, goal);
                return true;
            }
            displacement(window, r);
        }
        double fraction = 1.0;
        for (int k = 0; k <= HALVINGS; ++k) {
            fraction = k < HALVINGS ? fraction / 2 : 0.0;
            for (int64_t i = HISTORY * JOINTS; i < size; ++i)
                window[i] = base[i] + (k < HALVINGS ? (window[i] - base[i]) / 2 : 0.0);
            if (!passes(window)) continue;
            shift(walls, goal);
            for (int64_t j = 0; j < JOINTS; ++j) goal[j] = last_goal[j] + fraction * (goal[j] - last_goal[j]);
            return true;
        }
        return false;
    }

    // Move goals, (12,), out of the walls.
    void shift(Walls& walls, double* goal) const {
        double wanted[JOINTS], r[JOINTS];
        for (int64_t j = 0; j < JOINTS; ++j) wanted[j] = goal[j] - base_rest[j];
        walls.along(wanted, r);
        for (int64_t j = 0; j < JOINTS; ++j) goal[j] += r[j] - wanted[j];
    }
};

}  // namespace

// Replace the targets of rows `first` to `last` that the gate would refuse by others that it releases, if there are any.
EXPORT void lead_step(const Lead* l, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) {
        l->led[row] = 0;
        if (l->gate->reason[row] != NONE) continue;
        Leading leading(*l, row);
        if (leading.passes(leading.planned)) continue;
        const Adapter& a = *l->adapter;
        const double* before = a.before + row * ROWS * JOINTS;
        double goal[JOINTS], end[4 * JOINTS];
        copy(goal, before + GOAL * JOINTS, JOINTS);
        if (!leading.find(*l, before, goal)) continue;
        double *state = a.state + row * ROWS * JOINTS, planned[ROWS * JOINTS], commanded[JOINTS];
        copy(planned, state, ROWS * JOINTS);
        copy(commanded, a.commanded + row * JOINTS, JOINTS);
        copy(state, before, ROWS * JOINTS);
        const double* last_goal = state + (GOAL - 1) * JOINTS;
        for (int64_t j = 0; j < JOINTS; ++j) {
            const double here = (1.0 - a.approach) * last_goal[j];
            state[GOAL * JOINTS + j] = clamp(goal[j], here + a.lower[j], here + a.upper[j]);
        }
        resume(a, state, leading.window, end);
        keep(a, row, leading.window, end);
        // The adapter does not know of an arm that is held.
        for (int64_t k = 0; l->held >= 0 && k < ROWS; ++k)
            copy(state + k * JOINTS + 6 * l->held, planned + k * JOINTS + 6 * l->held, 6);
        if (l->held >= 0) copy(a.commanded + row * JOINTS + 6 * l->held, commanded + 6 * l->held, 6);
        a.rest[row] = 0;
        a.stops[row] = int64_t{1} << LED;
        l->led[row] = 1;
    }
}
