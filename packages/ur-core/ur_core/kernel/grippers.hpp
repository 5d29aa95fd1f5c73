// Controllers of the simulated grippers; see `dual_ur10.envs.sim.handling.GripperServos`.
#pragma once

#include "fields.hpp"
#include "numbers.hpp"

// Of the left, then of the right gripper: commands of the next `delay` ticks, references, and widths in every step.
#define GRIPPERS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                               \
    INT(n) INT(ticks) INT(substeps) INT(delay) REALS(step_m, 2) REALS(slack_m, 2)                                     \
    REALS(commanded_m, n * ticks * 2) REALS(opening_m, n * 2) REALS(waiting_m, n * delay * 2) REALS(reference_m, n * 2)                                  \
    REALS(widths_m, n * ticks * substeps * 2)

STRUCTURE(Grippers, GRIPPERS)

// Follow the commands, delayed, in rows `first` to `last`.
EXPORT void grippers_step(const Grippers* g, int64_t first, int64_t last) {
    const int64_t ticks = g->ticks, delay = g->delay;
    const Scratch queue(2 * (delay + ticks));
    for (int64_t row = first; row < last; ++row) {
        double *waiting = g->waiting_m + 2 * row * delay, *widths = g->widths_m + 2 * row * ticks * g->substeps;
        copy(queue, waiting, 2 * delay);
        copy(queue + 2 * delay, g->commanded_m + 2 * row * ticks, 2 * ticks);
        copy(waiting, queue + 2 * ticks, 2 * delay);
        for (int64_t side = 0; side < 2; ++side) {
            const double opening = g->opening_m[2 * row + side], step = g->step_m[side], slack = g->slack_m[side];
            double& reference = g->reference_m[2 * row + side];
            reference = clamp(reference, opening - slack, opening + slack);
            for (int64_t tick = 0; tick < ticks; ++tick) {
                const double before = reference;
                reference = before + clamp(queue[2 * tick + side] - before, -step, step);
                for (int64_t k = 0; k < g->substeps; ++k) {
                    const double ratio = static_cast<double>(k + 1) / static_cast<double>(g->substeps);
                    widths[2 * (tick * g->substeps + k) + side] = ratio * (reference - before) + before;
                }
            }
        }
    }
}
