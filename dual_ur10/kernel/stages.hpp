// Stages of a handover; see `dual_ur10.envs.tasks.handover.stages`.
#pragma once

#include "tool_goals.hpp"

// Facts of one row, two of each kind, of the giver and the receiver: between, holds, widths, nearness of the tools to
// their goals, goals of grippers, 1 for closed. Then the height of the block, its distance from the transfer, and 1 if it
// is placed. Terms: those of the giver, then of the receiver.
#define STAGES(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                                 \
    INT(n) REAL(lifted_m) REAL(meeting_m) LINK(approach, Approach) REALS(facts, n * 13) REALS(conditions, n * 7)       \
    INTS(stage, n) REALS(terms, n * 14)

STRUCTURE(Stages, STAGES)

namespace stages {

constexpr int COUNT = 7;

inline void check(const Stages& s, int64_t row) {
    const double* fact = s.facts + 13 * row;
    const bool gives = fact[2] > 0.0, receives = fact[3] > 0.0, lifted = fact[10] > s.lifted_m;
    const bool conditions[COUNT] = {fact[0] > 0.0,
                                    gives,
                                    gives && lifted,
                                    gives && lifted && fact[11] < s.meeting_m,
                                    gives && receives && lifted,
                                    !(fact[0] > 0.0) && receives && lifted,
                                    fact[12] > 0.0};
    for (int k = 0; k < COUNT; ++k) s.conditions[COUNT * row + k] = conditions[k];
}

inline void advance(const Stages& s, int64_t row) {
    const double* fact = s.facts + 13 * row;
    int64_t& stage = s.stage[row];
    while (stage < COUNT && s.conditions[COUNT * row + stage] > 0.0) ++stage;
    const bool gives = fact[2] > 0.0, receives = fact[3] > 0.0;
    // The goal that `near` refers to is that of this stage, not of the one before.
    const bool presents = gives && fact[10] > s.lifted_m, presented = presents && fact[11] < s.meeting_m;
    const bool carries = receives && !(fact[0] > 0.0);
    const Approach& approach = *s.approach;
    double near[2], shut[2], clear[2];
    for (int role = 0; role < 2; ++role) {
        const bool closes = fact[8 + role] > 0.0;
        const double width_m = fact[4 + role];
        clear[role] = clamp((width_m - approach.width_m) / (approach.clear_m - approach.width_m), 0.0, 1.0);
        near[role] = fact[6 + role] * (closes ? 1.0 : goals::opened(approach, width_m));
        shut[role] = closes && fact[role] > 0.0 ? goals::closed(approach, width_m) : 0.0;
    }
    const double taking = 0.6 * near[1] + 0.4 * shut[1];
    const double progress[2][COUNT] = {{2.0 * near[0], fact[0] > 0.0 ? near[0] + shut[0] : 0.0,
                                        gives ? 2.0 * clamp(fact[10] / s.lifted_m, 0.0, 1.0) : 0.0,
                                        presents ? near[0] : 0.0, presented ? near[0] : 0.0,
                                        receives ? 0.5 * near[0] + clear[0] : 0.0,
                                        receives ? 0.2 * near[0] + 0.2 * clear[0] : 0.0},
                                       {0.0, 0.0, 0.0, near[1], gives && receives ? 1.0 : presented ? taking : 0.0,
                                        receives ? 0.5 * near[1] : 0.0, carries ? 1.3 * near[1] : 0.0}};
    constexpr double done[2][COUNT] = {{2.0, 2.0, 2.0, 1.0, 1.0, 1.5, 0.4}, {0.0, 0.0, 0.0, 1.0, 1.0, 0.5, 1.6}};
    // Stages passed from which on a term is earned. The receiver's part of "present", to wait, begins at once.
    constexpr int begin[2][COUNT] = {{0, 1, 2, 3, 4, 5, 6}, {0, 1, 2, 0, 4, 5, 6}};
    for (int role = 0; role < 2; ++role)
        for (int k = 0; k < COUNT; ++k)
            s.terms[2 * COUNT * row + COUNT * role + k] =
                stage > k ? done[role][k] : (stage < begin[role][k] ? 0.0 : progress[role][k]);
}

}  // namespace stages

// Check the conditions of all stages in rows `first` to `last`, regardless of order.
EXPORT void stages_check(const Stages* s, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) stages::check(*s, row);
}

// Advance the stages of these rows by the conditions, and compute their reward terms.
EXPORT void stages_advance(const Stages* s, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) stages::advance(*s, row);
}
