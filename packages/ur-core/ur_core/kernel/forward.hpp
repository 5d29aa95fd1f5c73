// Forward kinematics of one arm by its Denavit-Hartenberg parameters; see `ur_core.kinematics.forward`.
#pragma once

#include "envelope.hpp"

namespace {


// Pose of the flange in `base` at joint angles (6,), and the frames whose z axes are the joints', if asked for.
void flange(const double* links, const double* q, Vector& position, Rotation& turned, Vector* origin, Vector* axis) {
    position = {0.0, 0.0, 0.0};
    turned = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
    for (int k = 0; k < 6; ++k) {
        const double* link = links + 13 * k;  // theta, rotation (3, 3), offset
        if (origin != nullptr) {
            origin[k] = position;
            axis[k] = turned.z;
        }
        const SineCosine t = sine_cosine(q[k] + link[0]);
        const Rotation joint = {{t.cosine, t.sine, 0.0}, {-t.sine, t.cosine, 0.0}, {0.0, 0.0, 1.0}};
        const Rotation before = turned * joint;
        position = position + rotate(before, vector(link + 10));
        turned = before * rotation(link + 1);
    }
}

void write(const Rotation& r, double* rows) {
    const double values[9] = {r.x.x, r.y.x, r.z.x, r.x.y, r.y.y, r.z.y, r.x.z, r.y.z, r.z.z};
    copy(rows, values, 9);
}

}  // namespace

// Flange poses of a chain (6, 13). A row of `block` (n, 18) gives joint angles and takes position and rotation.
SIZES(forward_pose, "78 18*$2 -")
EXPORT void forward_pose(const double* links, double* block, int64_t n) {
    for (int64_t row = 0; row < n; ++row) {
        double* here = block + 18 * row;
        Vector at;
        Rotation frame;
        flange(links, here, at, frame, nullptr, nullptr);
        write(at, here + 6);
        write(frame, here + 9);
    }
}

// The same, and behind them geometric Jacobians (6, 6): three rows of m/s, then three of rad/s. `block` is (n, 54).
SIZES(forward_jacobian, "78 54*$2 -")
EXPORT void forward_jacobian(const double* links, double* block, int64_t n) {
    for (int64_t row = 0; row < n; ++row) {
        double* here = block + 54 * row;
        Vector at, origin[6], axis[6];
        Rotation frame;
        flange(links, here, at, frame, origin, axis);
        write(at, here + 6);
        write(frame, here + 9);
        for (int k = 0; k < 6; ++k) {
            const Vector linear = cross(axis[k], at - origin[k]);
            const double column[6] = {linear.x, linear.y, linear.z, axis[k].x, axis[k].y, axis[k].z};
            for (int i = 0; i < 6; ++i) here[18 + 6 * i + k] = column[i];
        }
    }
}

// Points of arms with exactly parallel and perpendicular axes; `arm` holds lengths and tool centre point. A row of `block`
// (n, 15) gives joint angles and takes elbow, flange and tool centre point.
SIZES(forward_points, "9 15*$2 -")
EXPORT void forward_points(const double* arm, double* block, int64_t n) {
    for (int64_t row = 0; row < n; ++row) {
        double* here = block + 15 * row;
        const Points found = points_of_arm(arm, arm + 6, here);
        write(found.elbow, here + 6);
        write(found.flange, here + 9);
        write(found.tcp, here + 12);
    }
}
