// Poses of flanges and objects relative to each other; see `dual_ur10.envs.tasks.holding`.
#pragma once

#include "fields.hpp"
#include "numbers.hpp"

// Input of one row: quaternions and positions of both flanges, widths of both grippers, and the poses of the object and
// of further ones, all in the cell frame. Output: pose of the other flange in each flange's frame, position of each grip
// in its tool's frame, whether it is between the fingers, and whether they hold it; rotations of the first two poses; and
// all poses in the base frames of the left and the right arm.
#define GRASP_LIMITS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                           \
    REAL(width_m) REAL(width_margin_m) REALS(between_m, 6)
#define GRASPS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                                 \
    INT(n) INT(poses) INT(inputs) INT(outputs) REALS(tcp_m, 2) LINK(limits, GraspLimits) REALS(base_m, 6)              \
    REALS(to_base, 18) REALS(quat_to_base, 32) REALS(grip_m, n * 6) REALS(input, n * inputs)                           \
    REALS(output, n * outputs)

STRUCTURE(GraspLimits, GRASP_LIMITS)
STRUCTURE(Grasps, GRASPS)

namespace grasps {

inline Rotation from_quat(const double* q) {
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    const double ww = w * w, xx = x * x, yy = y * y, zz = z * z;
    return {{ww + xx - yy - zz, 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)},
            {2.0 * (x * y - w * z), ww - xx + yy - zz, 2.0 * (y * z + w * x)},
            {2.0 * (x * z + w * y), 2.0 * (y * z - w * x), ww - xx - yy + zz}};
}

// For a grip in the frame of an arm's tool.
inline bool is_between(const GraspLimits& s, int64_t arm, Vector grip) {
    const double* most = s.between_m + 3 * arm;
    return fabs(grip.x) < most[0] && fabs(grip.y) < most[1] && fabs(grip.z) < most[2];
}
inline bool holds(const GraspLimits& s, int64_t arm, Vector grip, double width_m) {
    return is_between(s, arm, grip) && fabs(width_m - s.width_m) < s.width_margin_m;
}

// Grip in the frame of a tool, from that of its flange.
inline Vector in_tool(const Rotation& flange, Vector flange_m, double tcp_m, Vector grip_m) {
    Vector found = rotate_back(flange, grip_m - flange_m);
    found.z -= tcp_m;
    return found;
}

// Conjugate of the first quaternion, times the second.
inline void between(const double* a, const double* b, double* out) {
    out[0] = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
    out[1] = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2];
    out[2] = a[0] * b[2] + a[1] * b[3] - a[2] * b[0] - a[3] * b[1];
    out[3] = a[0] * b[3] - a[1] * b[2] + a[2] * b[1] - a[3] * b[0];
}

inline void measure(const Grasps& s, int64_t row) {
    const double *quat = s.input + row * s.inputs, *flange_m = quat + 8, *width_m = quat + 14, *poses = quat + 16;
    double *other = s.output + row * s.outputs, *grip = other + 14, *inside = other + 20, *held = other + 22;
    double *rotations = other + 24, *bases = other + 42;
    const Rotation object = from_quat(poses + 3), second = from_quat(poses + 10);
    const Rotation both[2] = {object, second};
    for (int k = 0; k < 2; ++k) {
        const Vector columns[3] = {both[k].x, both[k].y, both[k].z};
        for (int i = 0; i < 3; ++i) {
            rotations[9 * k + i] = columns[i].x;
            rotations[9 * k + 3 + i] = columns[i].y;
            rotations[9 * k + 6 + i] = columns[i].z;
        }
    }
    for (int arm = 0; arm < 2; ++arm) {
        const int there = 1 - arm;
        const Rotation flange = from_quat(quat + 4 * arm);
        const Vector here = vector(flange_m + 3 * arm);
        write(rotate_back(flange, vector(flange_m + 3 * there) - here), other + 7 * arm);
        between(quat + 4 * arm, quat + 4 * there, other + 7 * arm + 3);
        const Vector wanted = vector(poses) + rotate(object, vector(s.grip_m + 6 * row + 3 * arm));
        const Vector tool = in_tool(flange, here, s.tcp_m[arm], wanted);
        write(tool, grip + 3 * arm);
        inside[arm] = is_between(*s.limits, arm, tool);
        held[arm] = holds(*s.limits, arm, tool, width_m[arm]);
        for (int64_t k = 0; k < s.poses; ++k) {
            const double *pose = poses + 7 * k, *turn = s.quat_to_base + 16 * arm;
            double* out = bases + 7 * (arm * s.poses + k);
            const Vector away = vector(pose) - vector(s.base_m + 3 * arm);
            write(rotate(rotation(s.to_base + 9 * arm), away), out);
            for (int j = 0; j < 4; ++j)
                out[3 + j] = pose[3] * turn[j] + pose[4] * turn[4 + j] + pose[5] * turn[8 + j] + pose[6] * turn[12 + j];
        }
    }
}

}  // namespace grasps

// Measure rows `first` to `last`.
EXPORT void grasps_measure(const Grasps* s, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) grasps::measure(*s, row);
}
