// Path of the carried bar; see `dual_ur10.envs.tasks.sync_carry.path`.
#pragma once

#include "fields.hpp"
#include "numbers.hpp"

namespace carry {

// The quaternion q, then a rotation by `angle` about its own axis 1, 2 or 3.
inline void turn(double* q, int axis, double angle) {
    const SineCosine half = sine_cosine(0.5 * angle);
    const int next = axis % 3 + 1, after = next % 3 + 1;
    const double w = q[0], along = q[axis], one = q[next], two = q[after];
    q[0] = w * half.cosine - along * half.sine;
    q[axis] = along * half.cosine + w * half.sine;
    q[next] = one * half.cosine + two * half.sine;
    q[after] = two * half.cosine - one * half.sine;
}

}  // namespace carry

// Poses (7,) at `count` times, of a bar that starts at a pose: position and quaternion. A move has a begin, a length, and
// changes of x, y, z, roll, pitch and yaw.
#define CARRY_PATH(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                             \
    INT(n) INT(count) INT(size) REALS(moves, size * 8) REALS(time_s, n * count) REALS(position_m, n * 3)               \
    REALS(quat, n * 4) REALS(poses, n * count * 7)

STRUCTURE(CarryPath, CARRY_PATH)

// Compute the poses of rows `first` to `last`.
EXPORT void carry_path(const CarryPath* p, int64_t first, int64_t last) {
    for (int64_t k = first * p->count; k < last * p->count; ++k) {
        const int64_t row = k / p->count;
        double change[6] = {}, *pose = p->poses + 7 * k;
        for (int64_t m = 0; m < p->size; ++m) {
            const double* move = p->moves + 8 * m;
            const double x = clamp((p->time_s[k] - move[0]) / move[1], 0.0, 1.0);
            const double ratio = x * x * x * (10.0 + x * (6.0 * x - 15.0));
            for (int i = 0; i < 6; ++i) change[i] += ratio * move[2 + i];
        }
        for (int i = 0; i < 3; ++i) pose[i] = p->position_m[3 * row + i] + change[i];
        copy(pose + 3, p->quat + 4 * row, 4);
        carry::turn(pose + 3, 3, change[5]);
        carry::turn(pose + 3, 1, change[3]);
        carry::turn(pose + 3, 2, change[4]);
    }
}
