// Errors, forces and loads of a carried bar; see `dual_ur10.envs.tasks.sync_carry.task`.
#pragma once

#include "tool_goals.hpp"

// Goals of both tools in the frame of the bar's reference, as positions and rotations in rows.
#define CARRY_GOALS(INT, REAL, INTS, REALS, LINK, FUNCTION) LINK(approach, Approach) REALS(grips, 24)

// Input of one row: time on the path; poses of the bar and of its reference now; forces on both grippers; the output of
// `grasps_measure` up to the rotations; widths of both grippers, and positions and quaternions of both flanges. Output:
// nearness of both tools to their goals; distance of the bar from its reference; a number that stays as it is; error of
// the arms' relative position; internal force along the bar and across it; slips; fractions of the load; sine and cosine
// of half the angles of the bar and of the arms' relative orientation; and for each gripper 1 if it holds the bar, less
// while it closes.
#define CARRY(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                                  \
    INT(n) INT(welded) REAL(duration_s) REAL(ramp_s) REAL(half_kg) REALS(ideal_m, 3) LINK(goals, CarryGoals)           \
    REALS(input, n * 79) REALS(slip_from_m, n * 6) REALS(worst_slip_m, n) REALS(carried_n, n * 2)                      \
    REALS(load_kg, n * 2) REALS(output, n * 17)

STRUCTURE(CarryGoals, CARRY_GOALS)
STRUCTURE(Carry, CARRY)

namespace carry {

using goals::length;

// Goal of a tool and its gripper: the grip on the reference, from behind until the gripper holds the bar.
struct Goal {
    goals::Step step;
    bool closes;
};

inline Goal goal(const CarryGoals& s, int64_t arm, const goals::Pose& reference, const goals::Pose& tool,
                 const goals::Grip& grip) {
    const goals::Pose there = reference * goals::pose(s.grips + 12 * arm);
    const goals::Step step = grip.holds ? goals::to(tool, there) : goals::along(*s.approach, tool, there, 0.0);
    return {step, grip.holds || goals::grasps_at(*s.approach, step, grip.between, grip.width_m)};
}

inline void evaluate(const Carry& s, int64_t row) {
    const double *input = s.input + 79 * row, *bar = input + 1, *reference = input + 8, *force = input + 15;
    const double *other = input + 21, *grip = input + 35, *between = input + 41;
    const double *holds = input + 43, *turned = input + 45, *width = input + 63, *at = input + 65;
    double *slip_from = s.slip_from_m + 6 * row, *output = s.output + 17 * row, *slip = output + 7;
    const double clock = input[0];
    const Approach& approach = *s.goals->approach;
    const goals::Pose ahead = {vector(reference), rotation(turned + 9)};
    const bool begun = clock > 0.0, under_way = begun && clock < s.duration_s;
    if (!begun) copy(slip_from, grip, 6);
    const Vector along = {turned[1], turned[4], turned[7]}, away = vector(force) - vector(force + 3);
    const Vector inner = {away.x / 2.0, away.y / 2.0, away.z / 2.0};
    const double internal = dot(inner, along);
    output[2] = length(vector(bar) - vector(reference));
    output[4] = length(vector(other) - vector(s.ideal_m));
    output[5] = internal;
    output[6] = length(inner - internal * along);
    double load[2];
    for (int arm = 0; arm < 2; ++arm) {
        const goals::Pose tool = goals::tool_of(approach, arm, goals::pose(at + 3 * arm, at + 6 + 4 * arm));
        const bool held = s.welded || holds[arm] > 0.0;
        const Goal found = goal(*s.goals, arm, ahead, tool, {between[arm] > 0.0, held, width[arm]});
        output[arm] = goals::nearness(approach, found.step) * (found.closes ? 1.0 : goals::opened(approach, width[arm]));
        output[15 + arm] = held ? 1.0 : found.closes ? 0.5 * goals::closed(approach, width[arm]) : 0.0;
        slip[arm] = length(vector(grip + 3 * arm) - vector(slip_from + 3 * arm));
        load[arm] = larger(-force[3 * arm + 2], 0.0);
        s.carried_n[2 * row + arm] += under_way ? load[arm] : 0.0;
    }
    const double whole = larger(load[0] + load[1], 1e-9);
    for (int arm = 0; arm < 2; ++arm) output[9 + arm] = load[arm] / whole;
    s.worst_slip_m[row] = begun ? larger(s.worst_slip_m[row], larger(slip[0], slip[1])) : 0.0;
    const bool due = clock > -s.ramp_s && clock < s.duration_s;
    const bool both = s.welded || (holds[0] > 0.0 && holds[1] > 0.0);
    for (int arm = 0; arm < 2; ++arm) s.load_kg[2 * row + arm] = due && both ? s.half_kg : 0.0;
    double turn[4];
    grasps::between(reference + 3, bar + 3, turn);
    output[11] = length(vector(turn + 1));
    output[12] = length(vector(other + 4));
    output[13] = fabs(turn[0]);
    output[14] = fabs(other[3]);
}

}  // namespace carry

// Evaluate rows `first` to `last`.
EXPORT void carry_evaluate(const Carry* s, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) carry::evaluate(*s, row);
}

// Each agent's own observation; the numbers say where further fields of an arm begin. `grip_m` are where the bar is held.
#define CARRY_AGENTS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                           \
    INT(n) INT(size) INT(own_size) LINK(tool, ToolFields) INT(bar) INT(ahead) LINK(goals, CarryGoals)                  \
    REALS(grip_m, 6) REALS(both, n * 2 * size) REALS(own, n * 2 * own_size)

STRUCTURE(CarryAgents, CARRY_AGENTS)

namespace carry {

inline void observe(const CarryAgents& s, int64_t row) {
    const goals::Seen seen = {*s.tool, s.both + 2 * row * s.size};
    const Approach& approach = *s.goals->approach;
    for (int64_t arm = 0; arm < 2; ++arm) {
        const goals::Pose bar = seen.at(arm, s.bar), tool = goals::tool_of(approach, arm, seen.commanded(arm));
        const Vector there = bar.at + rotate(bar.turn, vector(s.grip_m + 3 * arm));
        const goals::Grip grip = goals::grip(approach, seen, arm, there);
        const Goal found = goal(*s.goals, arm, seen.at(arm, s.ahead), tool, grip);
        double* own = s.own + (2 * row + arm) * s.own_size;
        goals::write_fields(approach, seen, arm, tool, found.step, grip, found.closes, own);
    }
}

}  // namespace carry

// Write the agents' observations of rows `first` to `last`.
EXPORT void carry_agents(const CarryAgents* s, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) carry::observe(*s, row);
}
