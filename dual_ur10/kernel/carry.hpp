// Errors, forces and loads of a carried bar; see `dual_ur10.envs.tasks.sync_carry.task`.
#pragma once

#include "fields.hpp"
#include "grasps.hpp"
#include "numbers.hpp"

// Input of one row: time on the path; poses of the bar and of its reference now; forces on both grippers; and the output
// of `grasps_measure` up to the rotations. Output: distances of both tools from their grips, and of the bar from its
// reference; a number that stays as it is; error of the arms' relative position; internal force along the bar and across
// it; slips; fractions of the load; sine and cosine of half the angles of the bar and of the arms' relative orientation.
#define CARRY(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                                  \
    INT(n) INT(welded) REAL(duration_s) REAL(ramp_s) REAL(half_kg) REALS(ideal_m, 3) REALS(input, n * 63)              \
    REALS(slip_from_m, n * 6) REALS(worst_slip_m, n) REALS(carried_n, n * 2) REALS(load_kg, n * 2)                     \
    REALS(output, n * 15)

STRUCTURE(Carry, CARRY)

namespace carry {

inline double length(Vector a) { return sqrt(squared(a)); }

inline void evaluate(const Carry& s, int64_t row) {
    const double *input = s.input + 63 * row, *bar = input + 1, *reference = input + 8, *force = input + 15;
    const double *other = input + 21, *grip = input + 35, *holds = input + 43, *turned = input + 45;
    double *slip_from = s.slip_from_m + 6 * row, *output = s.output + 15 * row, *slip = output + 7;
    const double clock = input[0];
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
        output[arm] = length(vector(grip + 3 * arm));
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
