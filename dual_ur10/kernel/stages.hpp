// Stages of a handover; see `dual_ur10.envs.tasks.handover.stages`.
#pragma once

#include "fields.hpp"
#include "numbers.hpp"

// Facts of one row, those of grippers of the giver, then of the receiver: between, holds, widths, distances of the tools
// from their grips; height of the block, its distances from meeting and target, its angle, and whether it is placed.
// Terms: those of the giver, then of the receiver.
#define STAGES(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                                 \
    INT(n) REAL(lifted_m) REAL(meeting_m) REAL(width_m) REAL(opening_m) REALS(margins, 6) REALS(facts, n * 13)         \
    REALS(conditions, n * 7) INTS(stage, n) REALS(terms, n * 14)

STRUCTURE(Stages, STAGES)

namespace stages {

constexpr int COUNT = 7;

inline void check(const Stages& s, int64_t row) {
    const double* fact = s.facts + 13 * row;
    const bool gives = fact[2] > 0.0, receives = fact[3] > 0.0, lifted = fact[8] > s.lifted_m;
    const bool conditions[COUNT] = {fact[0] > 0.0,
                                    gives,
                                    gives && lifted,
                                    gives && lifted && fact[9] < s.meeting_m,
                                    gives && receives && lifted,
                                    !gives && receives && lifted,
                                    fact[12] > 0.0};
    for (int k = 0; k < COUNT; ++k) s.conditions[COUNT * row + k] = conditions[k];
}

// 1 for a gripper at the block's width, 0 fully open or closed beyond it.
inline double closed(const Stages& s, double opening_m) {
    return larger(1.0 - fabs(opening_m - s.width_m) / (s.opening_m - s.width_m), 0.0);
}

inline void advance(const Stages& s, int64_t row) {
    const double *fact = s.facts + 13 * row, *away = fact + 6, *margin = s.margins;
    int64_t& stage = s.stage[row];
    while (stage < COUNT && s.conditions[COUNT * row + stage] > 0.0) ++stage;
    const bool gives = fact[2] > 0.0, receives = fact[3] > 0.0, placed = fact[12] > 0.0;
    const double giver = closed(s, fact[4]), receiver = fact[1] > 0.0 ? closed(s, fact[5]) : 0.0;
    const double joint = receives ? 1.0 : 0.5 * gaussian(away[1], margin[1]) + 0.5 * receiver;
    const double mutual = gives ? joint : 0.0;
    const double on_target = 0.7 * gaussian(fact[10], margin[4]) + 0.3 * gaussian(fact[11], margin[5]);
    const double progress[2][COUNT] = {{2.0 * gaussian(away[0], margin[0]), fact[0] > 0.0 ? 2.0 * giver : 0.0,
                                        gives ? 2.0 * clamp(fact[8] / s.lifted_m, 0.0, 1.0) : 0.0,
                                        gives ? gaussian(fact[9], margin[3]) : 0.0, mutual,
                                        receives ? 2.0 * (1.0 - giver) : 0.0, 0.0},
                                       {0.0, 0.0, 0.0, gaussian(away[1], margin[2]), mutual, 0.0,
                                        receives || placed ? 2.0 * on_target : 0.0}};
    constexpr double done[2][COUNT] = {{2.0, 2.0, 2.0, 1.0, 1.0, 2.0, 0.0}, {0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 2.0}};
    // Stages passed from which on a term is earned. "present" begins as soon as the block is held.
    constexpr int begin[COUNT] = {0, 1, 2, 2, 4, 5, 6};
    for (int role = 0; role < 2; ++role)
        for (int k = 0; k < COUNT; ++k)
            s.terms[2 * COUNT * row + COUNT * role + k] =
                stage > k ? done[role][k] : (stage < begin[k] ? 0.0 : progress[role][k]);
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
