// From targets to the controls of the simulated joint servos; see `dual_ur10.envs.sim.servo_reference` and
// `dual_ur10.envs.sim.feedforward`.
#pragma once

#include "fields.hpp"
#include "numbers.hpp"

// Rows of a motion of some physics steps: position before, speed after and acceleration in each step, then the state.
constexpr int64_t STATE = 3;

#define REFERENCE(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                              \
    INT(n) INT(inputs) INT(targets) INT(outputs) INT(count) REALS(matrices, count * outputs * inputs)                  \
    INTS(which, n * 2) REALS(state, n * 36) REALS(target, n * targets * 12) REALS(motion, n * outputs * 12)

STRUCTURE(Reference, REFERENCE)

// Follow the targets, (n, targets, 12), by the servoj law of each arm.
EXPORT void reference_step(const Reference* r, int64_t first, int64_t last) {
    const int64_t outputs = r->outputs, inputs = r->inputs;
    const Scratch input(inputs * JOINTS);
    for (int64_t row = first; row < last; ++row) {
        double *state = r->state + row * STATE * JOINTS, *motion = r->motion + row * outputs * JOINTS;
        copy(input, state, STATE * JOINTS);
        copy(input + STATE * JOINTS, r->target + row * r->targets * JOINTS, r->targets * JOINTS);
        const double* of_arm[2];
        for (int64_t arm = 0; arm < 2; ++arm) of_arm[arm] = r->matrices + r->which[2 * row + arm] * outputs * inputs;
        multiply(of_arm[0], outputs, inputs, input, motion);
        if (of_arm[1] != of_arm[0]) {
            double both[JOINTS];
            for (int64_t k = 0; k < outputs; ++k) {
                weighted(of_arm[1] + k * inputs, 0, inputs, input, both);
                copy(motion + k * JOINTS + 6, both + 6, 6);
            }
        }
        copy(state, motion + (outputs - STATE) * JOINTS, STATE * JOINTS);
    }
}

#define FEED_FORWARD(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                           \
    INT(n) INT(steps) INT(outputs) INT(stride) INT(block) INT(carries) REAL(damps_before_s) REAL(gravity_m_s2)         \
    REALS(offset_m, 39) REALS(turned, 117) REALS(axis, 39) REALS(mass_kg, 13) REALS(center_m, 39) REALS(inertia, 117)  \
    REALS(armature, 12) REALS(flange_m, 6) REALS(tcp_m, 6) REALS(compliance, 12) REALS(damping, 12)                    \
    REALS(declared_kg, n * 2) REALS(payload_kg, n * 4) REALS(motion, n * outputs * 12)                                 \
    REALS(control, n * steps * 2 * stride)

STRUCTURE(FeedForward, FEED_FORWARD)

namespace {

constexpr int LINKS = 6;

struct Symmetric {
    double xx, yy, zz, xy, xz, yz;
};

Vector operator*(const Symmetric& s, Vector a) {
    return {s.xx * a.x + s.xy * a.y + s.xz * a.z, s.xy * a.x + s.yy * a.y + s.yz * a.z,
            s.xz * a.x + s.yz * a.y + s.zz * a.z};
}

// Inertia of a body about its own centre, (3, 3) in its frame, in the cell frame.
Symmetric turned_inertia(const Rotation& r, const double* i) {
    const Rotation own = rotation(i);  // symmetric: columns are rows
    const Vector a = rotate(r, {dot(own.x, {r.x.x, r.y.x, r.z.x}), dot(own.y, {r.x.x, r.y.x, r.z.x}),
                                dot(own.z, {r.x.x, r.y.x, r.z.x})});
    const Vector b = rotate(r, {dot(own.x, {r.x.y, r.y.y, r.z.y}), dot(own.y, {r.x.y, r.y.y, r.z.y}),
                                dot(own.z, {r.x.y, r.y.y, r.z.y})});
    const Vector c = rotate(r, {dot(own.x, {r.x.z, r.y.z, r.z.z}), dot(own.y, {r.x.z, r.y.z, r.z.z}),
                                dot(own.z, {r.x.z, r.y.z, r.z.z})});
    return {a.x, b.y, c.z, a.y, a.z, b.z};
}

// Add the inertia of a mass at `away` from the reference point.
void add_point(Symmetric& s, double mass, Vector away) {
    s.xx += mass * (away.y * away.y + away.z * away.z);
    s.yy += mass * (away.x * away.x + away.z * away.z);
    s.zz += mass * (away.x * away.x + away.y * away.y);
    s.xy -= mass * away.x * away.y;
    s.xz -= mass * away.x * away.z;
    s.yz -= mass * away.y * away.z;
}

// One arm at a configuration: joint axes, bodies, and a point mass at its flange.
struct Arm {
    Vector origin[LINKS], axis[LINKS], center[LINKS + 1], flange, tcp;
    Symmetric inertia[LINKS + 1];
    double mass[LINKS + 1];

    Arm(const FeedForward& f, int64_t arm, const double* q, double declared_kg) {
        Vector at = {0.0, 0.0, 0.0};
        Rotation frame = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
        for (int link = 0; link < LINKS; ++link) {
            const int64_t body = 1 + LINKS * arm + link;
            at = at + rotate(frame, vector(f.offset_m + 3 * body));
            frame = frame * (rotation(f.turned + 9 * body) * about(vector(f.axis + 3 * body), q[link]));
            origin[link] = at;
            axis[link] = rotate(frame, vector(f.axis + 3 * body));
            center[link] = at + rotate(frame, vector(f.center_m + 3 * body));
            mass[link] = f.mass_kg[body];
            inertia[link] = turned_inertia(frame, f.inertia + 9 * body);
        }
        flange = at + rotate(frame, vector(f.flange_m + 3 * arm));
        tcp = at + rotate(frame, vector(f.tcp_m + 3 * arm));
        center[LINKS] = flange;
        mass[LINKS] = declared_kg;
        inertia[LINKS] = {};
    }

    // Joint-space inertia by composite bodies, (6, 6).
    void joint_inertia(const double* armature, double* m) const {
        double total = mass[LINKS];
        Vector first_moment = mass[LINKS] * center[LINKS];
        Symmetric about_cell = inertia[LINKS];
        add_point(about_cell, mass[LINKS], center[LINKS]);
        for (int j = LINKS - 1; j >= 0; --j) {
            total += mass[j];
            first_moment = first_moment + mass[j] * center[j];
            Symmetric own = inertia[j];
            add_point(own, mass[j], center[j]);
            about_cell = {about_cell.xx + own.xx, about_cell.yy + own.yy, about_cell.zz + own.zz,
                          about_cell.xy + own.xy, about_cell.xz + own.xz, about_cell.yz + own.yz};
            // Momentum of the bodies beyond joint j, and its moment about the cell's origin, at 1 rad/s of joint j.
            const Vector start = cross(origin[j], axis[j]);
            const Vector momentum = cross(axis[j], first_moment) + total * start;
            const Vector moment = about_cell * axis[j] + cross(first_moment, start);
            for (int i = 0; i <= j; ++i)
                m[i * LINKS + j] = m[j * LINKS + i] = dot(axis[i], moment - cross(origin[i], momentum));
            m[j * LINKS + j] += armature[j];
        }
    }

    // Torques of Coriolis and centrifugal terms at joint speeds v, (6,): recursive Newton-Euler without acceleration.
    void velocity_torque(const double* v, double* torque) const {
        Vector turning = {0.0, 0.0, 0.0}, angular = turning, linear = turning, before = origin[0];
        Vector force[LINKS + 1], moment[LINKS + 1];
        const auto inertial = [&](int body, int link) {
            const Vector away = center[body] - origin[link];
            force[body] = mass[body] * (linear + cross(angular, away) + cross(turning, cross(turning, away)));
            moment[body] = inertia[body] * angular + cross(turning, inertia[body] * turning);
        };
        for (int i = 0; i < LINKS; ++i) {
            const Vector step = origin[i] - before;
            linear = linear + cross(angular, step) + cross(turning, cross(turning, step));
            angular = angular + cross(turning, v[i] * axis[i]);
            turning = turning + v[i] * axis[i];
            before = origin[i];
            inertial(i, i);
        }
        inertial(LINKS, LINKS - 1);
        Vector sum = {0.0, 0.0, 0.0}, about_cell = sum;
        for (int i = LINKS; i >= 0; --i) {
            sum = sum + force[i];
            about_cell = about_cell + moment[i] + cross(center[i], force[i]);
            if (i < LINKS) torque[i] = dot(axis[i], about_cell - cross(origin[i], sum));
        }
    }
};

// Lead of the controls with which the servos exert the torques of the motion, for one arm and some physics steps:
// inertia and velocity terms are those in the middle.
void lead(const FeedForward& f, int64_t row, int64_t arm, const double* q, const double* v, const double* a,
          int64_t begin, int64_t count) {
    const int64_t middle = (begin + count / 2) * JOINTS + LINKS * arm;
    const Arm here(f, arm, q + middle, f.declared_kg[2 * row + arm]);
    double inertia[LINKS * LINKS], torque[LINKS], jacobian[3 * LINKS], mobility[LINKS * LINKS];
    here.joint_inertia(f.armature + LINKS * arm, inertia);
    here.velocity_torque(v + middle, torque);
    if (f.carries) {
        for (int i = 0; i < LINKS; ++i) {
            const Vector column = cross(here.axis[i], here.tcp - here.origin[i]);
            jacobian[3 * i] = column.x;
            jacobian[3 * i + 1] = column.y;
            jacobian[3 * i + 2] = column.z;
        }
        for (int i = 0; i < LINKS; ++i)
            for (int j = 0; j < LINKS; ++j)
                mobility[i * LINKS + j] = dot(vector(jacobian + 3 * i), vector(jacobian + 3 * j));
    }
    const double *compliance = f.compliance + LINKS * arm, *damping = f.damping + LINKS * arm;
    for (int64_t step = begin; step < begin + count; ++step) {
        const double *now = q + step * JOINTS + LINKS * arm, *speed = v + step * JOINTS + LINKS * arm;
        const double* acceleration = a + step * JOINTS + LINKS * arm;
        double* control = f.control + ((row * f.steps + step) * 2 + arm) * f.stride;
        const double ratio = static_cast<double>(step + 1) / static_cast<double>(f.steps);
        const double *before = f.payload_kg + 4 * row + arm, payload = before[0] + ratio * (before[2] - before[0]);
        for (int i = 0; i < LINKS; ++i) {
            double sum = torque[i];
            for (int j = 0; j < LINKS; ++j) sum += inertia[j * LINKS + i] * acceleration[j];
            if (f.carries) {
                double carried = f.gravity_m_s2 * jacobian[3 * i + 2];
                for (int j = 0; j < LINKS; ++j) carried += mobility[j * LINKS + i] * acceleration[j];
                sum += payload * carried;
            }
            // A servo that damps before the step does so at the speed there.
            control[i] = now[i] + damping[i] * (speed[i] - f.damps_before_s * acceleration[i]) + compliance[i] * sum;
        }
    }
}

}  // namespace

// Controls, (n, steps, 2, stride), of motions. The payload of each arm rises linearly from that before to that after.
EXPORT void feed_forward_step(const FeedForward* f, int64_t first, int64_t last) {
    const int64_t size = f->steps * JOINTS;
    for (int64_t row = first; row < last; ++row) {
        const double* q = f->motion + row * f->outputs * JOINTS;
        for (int64_t begin = 0; begin < f->steps; begin += f->block) {
            const int64_t count = f->steps - begin < f->block ? f->steps - begin : f->block;
            for (int64_t arm = 0; arm < 2; ++arm) lead(*f, row, arm, q, q + size, q + 2 * size, begin, count);
        }
    }
}
