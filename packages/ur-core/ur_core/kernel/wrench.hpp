// Wrenches of objects on grippers; see `dual_ur10.envs.sim.handling`.
#pragma once

#include <math.h>

#include "fields.hpp"
#include "numbers.hpp"

// Forces and torques of the wrists on the grippers, (2, 2, 3), and orientations, (2, 4), of both flanges, in the arms'
// `base` frames, give the wrenches, (2, 6), in these frames. `moment_nm` are the grippers' weights times their levers; `up` is
// the direction against gravity in each frame, (2, 3).
#define WRENCH(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                                 \
    INT(n) REALS(weight_n, 2) REALS(moment_nm, 6) REALS(up, 6) REALS(sensed, n * 12) REALS(quat, n * 8)                \
    REALS(wrench, n * 12)

STRUCTURE(Wrench, WRENCH)

namespace wrench {

// Rows of the rotation matrix of a quaternion.
inline void matrix(const double* q, double* r) {
    const double w = q[0], x = q[1], y = q[2], z = q[3], ww = w * w, xx = x * x, yy = y * y, zz = z * z;
    const double wx = w * x, wy = w * y, wz = w * z, xy = x * y, xz = x * z, yz = y * z;
    const double rows[9] = {ww + xx - yy - zz, xy - wz + xy - wz, wy + xz + wy + xz,
                            wz + xy + xy + wz, ww - xx + yy - zz, yz - (wx + wx) + yz,
                            xz - wy - wy + xz, wx + wx + yz + yz, (ww - yy) + (zz - xx)};
    copy(r, rows, 9);
}

// Components of a vector along the rows. Fused products, too, are the same on every processor.
inline Vector turned(const double* r, double x, double y, double z) {
    double out[3];
    for (int k = 0; k < 3; ++k) out[k] = fma(z, r[3 * k + 2], fma(y, r[3 * k + 1], x * r[3 * k]));
    return vector(out);
}

inline void compute(const Wrench& s, int64_t row) {
    for (int arm = 0; arm < 2; ++arm) {
        const double *force = s.sensed + 12 * row + 3 * arm, *torque = force + 6, *weight = s.moment_nm + 3 * arm;
        double r[9], *out = s.wrench + 12 * row + 6 * arm;
        matrix(s.quat + 8 * row + 4 * arm, r);
        const Vector f = turned(r, -force[0], -force[1], -force[2]), t = turned(r, -torque[0], -torque[1], -torque[2]);
        const Vector moment = turned(r, weight[0], weight[1], weight[2]);
        const Vector up = vector(s.up + 3 * arm), lift = s.weight_n[arm] * up, about = cross(moment, up);
        const double values[6] = {f.x + lift.x, f.y + lift.y, f.z + lift.z,
                                  t.x + about.x, t.y + about.y, t.z + about.z};
        copy(out, values, 6);
    }
}

}  // namespace wrench

// Compute the wrenches of rows `first` to `last`.
EXPORT void wrench_compute(const Wrench* s, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) wrench::compute(*s, row);
}
