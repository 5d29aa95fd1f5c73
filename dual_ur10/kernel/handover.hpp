// Distances and facts of a handover; see `dual_ur10.envs.tasks.handover.task`.
#pragma once

#include "fields.hpp"
#include "numbers.hpp"

// Input of one row: poses of the block and of the target, the output of `grasps_measure` up to the rotations, and widths
// of both grippers. `before_m` is where the block was in the last step. Output: distance of the block from its target;
// sine and cosine of the angle between their long axes; and 1 if the block is lost. `facts` are those of the stages, but
// for the angle: a block that is near its target, still, and held by no gripper counts as placed.
#define HANDOVER(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                               \
    INT(n) REAL(still_m) REAL(success_error_m) REALS(far_m, 2) REAL(fallen_m) REALS(meeting_m, 3) REALS(shoulders_m, 6)    \
    INTS(giver, n) REALS(input, n * 58) REALS(before_m, n * 3) REALS(slip_from_m, n * 6) REALS(slip_m, n * 2)          \
    REALS(facts, n * 13) REALS(output, n * 4)

STRUCTURE(Handover, HANDOVER)

namespace handover {

inline double distance(Vector a, const double* b) { return sqrt(squared(a - vector(b))); }

inline void evaluate(const Handover& s, int64_t row) {
    const double *input = s.input + 58 * row, *target = input + 7, *grip = input + 28, *between = input + 34;
    const double *holds = input + 36, *turned = input + 38, *width = input + 56;
    double *before = s.before_m + 3 * row, *facts = s.facts + 13 * row, *output = s.output + 4 * row;
    const Vector block = vector(input);
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
        facts[6 + role] = sqrt(squared(vector(own)));
    }
    output[0] = distance(block, target);
    // The long axes are the first columns, whichever long side is up.
    const Vector first = {turned[0], turned[3], turned[6]}, second = {turned[9], turned[12], turned[15]};
    output[1] = sqrt(squared(cross(first, second)));
    output[2] = dot(first, second);
    const bool far = distance(block, s.shoulders_m) > s.far_m[0] && distance(block, s.shoulders_m + 3) > s.far_m[1];
    output[3] = far || block.z < s.fallen_m;
    facts[8] = block.z;
    facts[9] = distance(block, s.meeting_m);
    facts[10] = output[0];
    const bool held = holds[0] > 0.0 || holds[1] > 0.0;
    facts[12] = distance(block, before) < s.still_m && output[0] < s.success_error_m && !held;
    copy(before, input, 3);
}

}  // namespace handover

// Evaluate rows `first` to `last`.
EXPORT void handover_evaluate(const Handover* s, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) handover::evaluate(*s, row);
}
