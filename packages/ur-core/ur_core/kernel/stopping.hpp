// Soonest stop of joints beside their commands' line; see `dual_ur10.sim2real.control.stopping`.
#pragma once

#include "envelope.hpp"

constexpr int64_t CARRIED = 5;  // of a joint: its last three targets, its arm's position and speed

#define STOPPING(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                               \
    INT(latest) INT(ticks) REAL(tick_s) REAL(period_s) REAL(lead_s) REAL(lookahead_s) REAL(acceleration_rad_s2)        \
    REAL(jerk_rad_s3) REALS(gains, latest * 5) REALS(arm, 12)

STRUCTURE(Stopping, STOPPING)

namespace {

// One of the twelve bits of a mask of joints.
bool has(int64_t mask, int64_t joint) { return mask >> joint & 1; }

// Targets of a stop and where it ends, both relative to the line.
struct Stop {
    const Stopping& s;
    const Scratch targets;  // (ticks, 12) of the next period
    double end[JOINTS] = {};
    double used = 0.0;  // largest fraction of a limit
    int64_t count = 0;  // ticks until the end

    explicit Stop(const Stopping& stopping) : s(stopping), targets(stopping.ticks * JOINTS) {}

    // Plan a stop after `until` ticks. It is left unfinished where it uses more than `most` of a limit.
    void plan(const double* begin, int64_t until, double most) {
        double carried[CARRIED * JOINTS], peak[JOINTS] = {};
        double *u3 = carried, *u2 = u3 + JOINTS, *u1 = u2 + JOINTS, *q = u1 + JOINTS, *v = q + JOINTS;
        copy(carried, begin, CARRIED * JOINTS);
        const double tick2 = s.tick_s * s.tick_s;
        const double of_second = 1.0 / (tick2 * s.acceleration_rad_s2), of_third = 1.0 / (tick2 * s.tick_s * s.jerk_rad_s3);
        count = until;
        used = 0.0;
        for (int64_t k = 0; k < until + HISTORY - 1 && used <= most; ++k) {
            if (k < until) weighted(s.gains + CARRIED * (until - 1 - k), 0, CARRIED, carried, end);
            for (int64_t j = 0; j < JOINTS; ++j) {
                const double u = end[j], second = (u - u1[j]) - (u1[j] - u2[j]), before = (u1[j] - u2[j]) - (u2[j] - u3[j]);
                peak[j] = larger(peak[j], larger(fabs(second) * of_second, fabs(second - before) * of_third));
                const double at = along(s.arm, u3[j], u2[j], u1[j], q[j], v[j], u);
                v[j] = along(s.arm + CARRIED + 1, u3[j], u2[j], u1[j], q[j], v[j], u);
                q[j] = at;
                u3[j] = u2[j];
                u2[j] = u1[j];
                u1[j] = u;
            }
            for (int64_t j = 0; j < JOINTS; ++j) used = larger(used, peak[j]);
            if (k < s.ticks) copy(targets + k * JOINTS, end, JOINTS);
        }
        for (int64_t k = until; k < s.ticks; ++k) copy(targets + k * JOINTS, end, JOINTS);
    }

    // Plan the soonest stop that keeps a fraction `full` of the limits. Returns false if there is none.
    bool soonest(const double* begin, double full) {
        double fastest = 0.0;
        for (int64_t j = 0; j < JOINTS; ++j) fastest = larger(fastest, fabs(begin[(CARRIED - 1) * JOINTS + j]));
        // Sooner stops take more acceleration. Between two that differ by little, the blend of both is as good.
        const double least = smaller(fastest / (s.tick_s * s.acceleration_rad_s2), 1e6);
        int64_t late = 2 + static_cast<int64_t>(least), soon = 1;
        for (;;) {
            if (late > s.latest) return false;
            plan(begin, late, full);
            if (used <= full) break;
            soon = late;
            late += 1 + late / 3;
        }
        while (late - soon > 1 + late / 16) {
            const int64_t middle = (late + soon) / 2;
            plan(begin, middle, full);
            (used <= full ? late : soon) = middle;
        }
        plan(begin, late, full);
        if (soon > 1) {
            Stop sooner(s);
            sooner.plan(begin, soon, HUGE_VAL);
            if (sooner.used > full) blend(sooner, (full - used) / (sooner.used - used));
        }
        return true;
    }

    // True if the joints are at rest beside the line at the end of the next period.
    bool over() const { return count <= s.ticks; }

  private:
    void blend(const Stop& other, double fraction) {
        for (int64_t i = 0; i < s.ticks * JOINTS; ++i) targets[i] += fraction * (other.targets[i] - targets[i]);
        for (int64_t j = 0; j < JOINTS; ++j) end[j] += fraction * (other.end[j] - end[j]);
    }

    static double along(const double* row, double u3, double u2, double u1, double q, double v, double u) {
        return row[0] * u3 + row[1] * u2 + row[2] * u1 + row[3] * q + row[4] * v + row[5] * u;
    }
};

}  // namespace
