// Distances and facts of a handover; see `dual_ur10.envs.tasks.handover.task`.
#pragma once

#include "handover_goals.hpp"

// Input of one row: poses of the block and of the target, the output of `grasps_measure` up to the rotations, widths of
// both grippers, and positions and quaternions of both flanges. `before_m` is where the block was in the last step.
// Output: distance of the block from its target; sine and cosine of the angle between their long axes; and 1 if the
// block is lost. `facts` are those of the stages, but for the angle: a block that is near its target, still, and held
// by no gripper counts as placed.
#define HANDOVER(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                               \
    INT(n) REAL(still_m) REAL(success_error_m) REALS(far_m, 2) REAL(fallen_m) REALS(shoulders_m, 6)                    \
    LINK(goals, HandoverGoals) INTS(giver, n) REALS(input, n * 72) REALS(before_m, n * 3) REALS(slip_from_m, n * 6)    \
    REALS(slip_m, n * 2) REALS(facts, n * 13) REALS(output, n * 4)

STRUCTURE(Handover, HANDOVER)

namespace handover {

inline double distance(Vector a, const double* b) { return sqrt(squared(a - vector(b))); }

inline void evaluate(const Handover& s, int64_t row) {
    const double *input = s.input + 72 * row, *target = input + 7, *grip = input + 28, *between = input + 34;
    const double *holds = input + 36, *turned = input + 38, *width = input + 56, *at = input + 58;
    double *before = s.before_m + 3 * row, *facts = s.facts + 13 * row, *output = s.output + 4 * row;
    const Vector block = vector(input);
    const goals::Scene scene = {s.giver[row], {block, rotation(turned)}, {vector(target), rotation(turned + 9)},
                                 between, holds, width};
    const goals::Phase phase = goals::phase(*s.goals, scene);
    for (int64_t role = 0; role < 2; ++role) {
        const int64_t arm = role ? 1 - s.giver[row] : s.giver[row];
        const double* own = grip + 3 * arm;
        double* slip_from = s.slip_from_m + 6 * row + 3 * arm;
        if (holds[arm] > 0.0)
            s.slip_m[2 * row + arm] = distance(vector(own), slip_from);
        else
            copy(slip_from, own, 3);
        facts[role] = between[arm];
        facts[2 + role] = holds[arm];
        facts[4 + role] = width[arm];
        const goals::Pose tool = goals::tool_of(*s.goals, goals::pose(at + 3 * arm, at + 6 + 4 * arm));
        const goals::Step step = goals::step(*s.goals, scene, phase, arm, tool);
        facts[6 + role] = goals::nearness(*s.goals, step);
        facts[8 + role] = goals::closes(*s.goals, scene, phase, arm, step);
    }
    output[0] = distance(block, target);
    // The long axes are the first columns, whichever long side is up.
    const Vector first = {turned[0], turned[3], turned[6]}, second = {turned[9], turned[12], turned[15]};
    output[1] = sqrt(squared(cross(first, second)));
    output[2] = dot(first, second);
    const bool far = distance(block, s.shoulders_m) > s.far_m[0] && distance(block, s.shoulders_m + 3) > s.far_m[1];
    output[3] = far || block.z < s.fallen_m;
    facts[10] = block.z;
    facts[11] = goals::off_m(*s.goals, scene.giver, scene.block);
    const bool held = holds[0] > 0.0 || holds[1] > 0.0;
    facts[12] = distance(block, before) < s.still_m && output[0] < s.success_error_m && !held;
    copy(before, input, 3);
}

}  // namespace handover

// Evaluate rows `first` to `last`.
EXPORT void handover_evaluate(const Handover* s, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) handover::evaluate(*s, row);
}

// Each agent's own observation: the `size` numbers of its arm, and behind them the goals' fields, in their order; see
// `GOAL_FIELDS` of `dual_ur10.envs.tasks.handover.goals`. The other numbers say where the fields of an arm begin;
// `links` are the two chains.
#define HANDOVER_AGENTS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                        \
    INT(n) INT(size) INT(own_size) INT(commanded) INT(flange) INT(gripper) INT(block) INT(target) INT(role)            \
    REAL(opening_m) REAL(near_m) REAL(near) REALS(links, 156) REALS(base_m, 6) REALS(to_base, 18)                      \
    LINK(grips, GraspLimits) LINK(goals, HandoverGoals) REALS(both, n * 2 * size) REALS(own, n * 2 * own_size)

STRUCTURE(HandoverAgents, HANDOVER_AGENTS)

namespace handover {

inline goals::Pose in_cell(const HandoverAgents& s, int64_t arm, const goals::Pose& pose) {
    const Rotation to_base = rotation(s.to_base + 9 * arm);
    const Rotation& r = pose.turn;
    return {vector(s.base_m + 3 * arm) + rotate_back(to_base, pose.at),
            {rotate_back(to_base, r.x), rotate_back(to_base, r.y), rotate_back(to_base, r.z)}};
}

inline void observe(const HandoverAgents& s, int64_t row) {
    const double* both = s.both + 2 * row * s.size;
    const int64_t giver = both[s.role] > 0.0 ? 0 : 1;
    const auto seen = [&](int64_t arm, int64_t field) {
        const double* numbers = both + arm * s.size + field;
        return in_cell(s, arm, goals::pose(numbers, numbers + 3));
    };
    double between[2], holds[2], width_m[2];
    goals::Scene scene = {giver, seen(giver, s.block), seen(giver, s.target), between, holds, width_m};
    for (int64_t arm = 0; arm < 2; ++arm) {
        const goals::Pose flange = seen(arm, s.flange);
        const Vector grip = scene.block.at + rotate(scene.block.turn, vector(s.goals->grip_m + 6 * giver + 3 * arm));
        const Vector away = grasps::in_tool(flange.turn, flange.at, s.goals->tcp_m, grip);
        between[arm] = grasps::is_between(*s.grips, away);
        width_m[arm] = both[arm * s.size + s.gripper];
        holds[arm] = grasps::holds(*s.grips, away, width_m[arm]);
    }
    const goals::Phase phase = goals::phase(*s.goals, scene);
    for (int64_t arm = 0; arm < 2; ++arm) {
        goals::Pose flange_pose;
        const double* commanded = both + arm * s.size + s.commanded;
        flange(s.links + 78 * arm, commanded, flange_pose.at, flange_pose.turn, nullptr, nullptr);
        const goals::Pose tool = goals::tool_of(*s.goals, in_cell(s, arm, flange_pose));
        const goals::Step step = goals::step(*s.goals, scene, phase, arm, tool);
        const goals::Step lag = goals::to(goals::tool_of(*s.goals, seen(arm, s.flange)), tool);
        double *own = s.own + (2 * row + arm) * s.own_size, *more = own + s.size;
        copy(own, both + arm * s.size, s.size);
        write(step.move, more);
        write(step.turn, more + 3);
        const auto near = [](Vector v, double scale) { return (1.0 / (scale + goals::length(v))) * v; };
        write(near(step.move, s.near_m), more + 6);
        write(near(step.turn, s.near), more + 9);
        write(near(lag.move, s.near_m), more + 12);
        write(near(lag.turn, s.near), more + 15);
        more[18] = between[arm];
        more[19] = width_m[arm] / s.opening_m;
        more[20] = !goals::closes(*s.goals, scene, phase, arm, step);
        more[21] = s.near_m / (s.near_m + step.left_m);
        more[22] = s.near / (s.near + goals::length(step.turn));
    }
}

}  // namespace handover

// Write the agents' observations of rows `first` to `last`.
EXPORT void handover_agents(const HandoverAgents* s, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) handover::observe(*s, row);
}
