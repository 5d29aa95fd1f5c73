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
        const goals::Pose tool = goals::tool_of(*s.goals->approach, arm, goals::pose(at + 3 * arm, at + 6 + 4 * arm));
        const goals::Step step = goals::step(*s.goals, scene, phase, arm, tool);
        facts[6 + role] = goals::nearness(*s.goals->approach, step);
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

// Each agent's own observation; the numbers say where further fields of an arm begin.
#define HANDOVER_AGENTS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                        \
    INT(n) INT(size) INT(own_size) LINK(tool, ToolFields) INT(block) INT(target) INT(role)                             \
    LINK(goals, HandoverGoals) REALS(both, n * 2 * size) REALS(own, n * 2 * own_size)

STRUCTURE(HandoverAgents, HANDOVER_AGENTS)

namespace handover {

inline void observe(const HandoverAgents& s, int64_t row) {
    const goals::Seen seen = {*s.tool, s.both + 2 * row * s.size};
    const Approach& approach = *s.goals->approach;
    const int64_t giver = seen.number(0, s.role) > 0.0 ? 0 : 1;
    double between[2], holds[2], width_m[2];
    goals::Scene scene = {giver, seen.at(giver, s.block), seen.at(giver, s.target), between, holds, width_m};
    goals::Grip grips[2];
    for (int64_t arm = 0; arm < 2; ++arm) {
        const Vector there = vector(s.goals->grip_m + 6 * giver + 3 * arm);
        grips[arm] = goals::grip(approach, seen, arm, scene.block.at + rotate(scene.block.turn, there));
        between[arm] = grips[arm].between;
        holds[arm] = grips[arm].holds;
        width_m[arm] = grips[arm].width_m;
    }
    const goals::Phase phase = goals::phase(*s.goals, scene);
    for (int64_t arm = 0; arm < 2; ++arm) {
        const goals::Pose tool = goals::tool_of(approach, arm, seen.commanded(arm));
        const goals::Step step = goals::step(*s.goals, scene, phase, arm, tool);
        const bool closes = goals::closes(*s.goals, scene, phase, arm, step);
        double* own = s.own + (2 * row + arm) * s.own_size;
        goals::write_fields(approach, seen, arm, tool, step, grips[arm], closes, own);
    }
}

}  // namespace handover

// Write the agents' observations of rows `first` to `last`.
EXPORT void handover_agents(const HandoverAgents* s, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) handover::observe(*s, row);
}
