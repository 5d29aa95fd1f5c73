// References, errors and rewards of SineTracking; see `dual_ur10.envs.tasks.sine_tracking.task`.
#pragma once

#include "forward.hpp"

// Input and output of one row, in this order: time, orientations and positions of both flanges; then references in both
// bases, now and ahead, rotations, references and errors in the cell frame, sizes of the errors, and reward terms. A row
// of `wave` is amplitude, angular frequency and phase.
#define SINE(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                                   \
    INT(n) REAL(soft_start_s) REAL(ahead_s) REAL(lever_m) REALS(scales_m, 3) REALS(margins, 5)                         \
    REALS(to_reference, 16) REALS(wave, n * 3) REALS(along, n * 18) REALS(center_m, n * 18) REALS(input, n * 15)       \
    REALS(output, n * 43)

STRUCTURE(Sine, SINE)

namespace {

double displacement(const Sine& s, double time_s, const double* wave) {
    const double value = wave[0] * sine_cosine(time_s * wave[1] + wave[2]).sine;
    if (time_s >= s.soft_start_s) return value;
    const double x = time_s / s.soft_start_s;
    return value * (x * x * x * (10.0 + x * (6.0 * x - 15.0)));
}

void measure(const Sine& s, int64_t row) {
    const double *input = s.input + 15 * row, *center = s.center_m + 18 * row, *along = s.along + 18 * row;
    const double *quat = input + 1, *flange = input + 9, *wave = s.wave + 3 * row;
    double *output = s.output + 43 * row, *rotation = output + 12, *error = output + 24, *sizes = output + 30;
    const double now = displacement(s, input[0], wave);
    const double ahead = displacement(s, input[0] + s.ahead_s, wave);
    for (int k = 0; k < 6; ++k) {
        output[k] = center[k] + now * along[k];
        output[6 + k] = center[6 + k] + ahead * along[6 + k];
        output[18 + k] = center[12 + k] + now * along[12 + k];
        error[k] = output[18 + k] - flange[k];
    }
    for (int arm = 0; arm < 2; ++arm) {
        double turn[4] = {};
        for (int k = 0; k < 4; ++k)
            for (int i = 0; i < 4; ++i) turn[i] += quat[4 * arm + k] * s.to_reference[4 * k + i];
        for (int i = 0; i < 3; ++i) rotation[3 * arm + i] = copysign(2.0, turn[0]) * turn[1 + i];
        sizes[arm] = sqrt(squared(vector(error + 3 * arm)));
        sizes[2 + arm] = sqrt(squared(vector(rotation + 3 * arm)));
    }
    sizes[4] = sqrt(squared(vector(error) - vector(error + 3)));
    for (int arm = 0; arm < 2; ++arm) {
        double* terms = output + 35 + 4 * arm;
        const double away = sizes[arm] + s.lever_m * sizes[2 + arm];
        terms[0] = 0.0;
        for (int k = 0; k < 3; ++k) terms[0] += s.scales_m[k] / (3.0 * (s.scales_m[k] + away));
        for (int k = 0; k < 3; ++k) {
            const int size = k < 2 ? 2 * k + arm : 4;
            terms[1 + k] = gaussian(sizes[size], s.margins[size]);
        }
    }
}

}  // namespace

// Measure rows `first` to `last`.
EXPORT void sine_measure(const Sine* s, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) measure(*s, row);
}

// Steps from the commanded flanges to references, (n, 12): translations, then rotation vectors, of both arms in their
// own bases. `down` is the reference's orientation there; `links` are the two chains.
#define SINE_STEPS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                             \
    INT(n) REALS(links, 156) REALS(down, 9) REALS(commanded, n * 12) REALS(ahead, n * 6) REALS(steps, n * 12)

STRUCTURE(SineSteps, SINE_STEPS)

// Write the steps of rows `first` to `last`.
EXPORT void sine_steps(const SineSteps* s, int64_t first, int64_t last) {
    for (int64_t side = 2 * first; side < 2 * last; ++side) {
        Vector at;
        Rotation frame;
        flange(s->links + 78 * (side & 1), s->commanded + 6 * side, at, frame, nullptr, nullptr);
        write(vector(s->ahead + 3 * side) - at, s->steps + 6 * side);
        write(rotation_from(frame, rotation(s->down)), s->steps + 6 * side + 3);
    }
}

// Each agent's own observation: the `size` numbers of its arm, and the pose of the other flange in its own base frame.
// `others` gives that as a product with the pose in the other base frame, and a 1; it begins at the number `pose`.
#define SINE_AGENTS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                            \
    INT(n) INT(size) INT(own_size) INT(pose) REALS(others, 112) REALS(both, n * 2 * size) REALS(own, n * 2 * own_size)

STRUCTURE(SineAgents, SINE_AGENTS)

// Write the agents' observations of rows `first` to `last`.
EXPORT void sine_agents(const SineAgents* s, int64_t first, int64_t last) {
    for (int64_t side = 2 * first; side < 2 * last; ++side) {
        const double *numbers = s->both + side * s->size, *other = s->both + (side ^ 1) * s->size + s->pose;
        const double* product = s->others + 56 * (side & 1);
        double *own = s->own + side * s->own_size, *pose = own + s->size;
        for (int64_t k = 0; k < s->size; ++k) own[k] = numbers[k];
        for (int k = 0; k < 7; ++k) pose[k] = product[49 + k];
        for (int i = 0; i < 7; ++i)
            for (int k = 0; k < 7; ++k) pose[k] += other[i] * product[7 * i + k];
    }
}
