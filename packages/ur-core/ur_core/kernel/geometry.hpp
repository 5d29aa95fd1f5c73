// Poses, grasps, and steps of tools to their goals; see `dual_ur10.envs.tasks.geometry`.
//
// Poses that Python gives are position and quaternion (7,). Frames are position and rotation matrix by rows (12,).
#pragma once

#include "forward.hpp"

// Input: poses of both flanges, openings of both grippers, and poses of objects, in the cell frame. Each arm grips the
// object `held` at `grip_m`, in the object's frame, where it is `width_m` wide. `between_m` bounds a grip in the frame of
// its tool. Output: frames of both tools and of the objects; pose of the other flange in each flange's frame; grips in the
// frames of their tools, 1 if a grip is between the fingers, and 1 if they hold it; progress of fingers that open to
// `most_m`, close to the object's width, or clear it; poses in the bases of both arms.
#define GRASPS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                                 \
    INT(n) INT(objects) REAL(width_margin_m) REALS(tcp_m, 2) REALS(between_m, 6) REALS(width_m, 2) INTS(held, 2)       \
    REALS(most_m, 2) REAL(clearance_m)                                                                                 \
    REALS(base_m, 6) REALS(to_base, 18) REALS(quat_to_base, 32) REALS(grip_m, n * 6) REALS(flange_m, n * 6)            \
    REALS(flange_quat, n * 8) REALS(opening_m, n * 2) REALS(poses, n * objects * 7) REALS(tools, n * 24)               \
    REALS(frames, n * objects * 12) REALS(other_flange, n * 14) REALS(grip_in_tool_m, n * 6) REALS(between, n * 2)     \
    REALS(holding, n * 2) REALS(opened, n * 2) REALS(closed, n * 2) REALS(cleared, n * 2)                              \
    REALS(in_bases, n * objects * 14)

STRUCTURE(Grasps, GRASPS)

namespace geometry {

struct Frame {
    Vector at;
    Rotation turn;
};

inline Frame frame(const double* from) { return {vector(from), rotation(from + 3)}; }
inline Frame operator*(const Frame& a, const Frame& b) { return {a.at + rotate(a.turn, b.at), a.turn * b.turn}; }
inline void put(const Frame& a, double* to) {
    write(a.at, to);
    write(a.turn, to + 3);
}
inline double length(Vector a) { return sqrt(squared(a)); }

inline Rotation from_quat(const double* q) {
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    const double ww = w * w, xx = x * x, yy = y * y, zz = z * z;
    return {{ww + xx - yy - zz, 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)},
            {2.0 * (x * y - w * z), ww - xx + yy - zz, 2.0 * (y * z + w * x)},
            {2.0 * (x * z + w * y), 2.0 * (y * z - w * x), ww - xx - yy + zz}};
}

// Conjugate of the first quaternion, times the second.
inline void between(const double* a, const double* b, double* out) {
    out[0] = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
    out[1] = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2];
    out[2] = a[0] * b[2] + a[1] * b[3] - a[2] * b[0] - a[3] * b[1];
    out[3] = a[0] * b[3] - a[1] * b[2] + a[2] * b[1] - a[3] * b[0];
}

inline void grasp(const Grasps& s, int64_t row) {
    const double *flange_m = s.flange_m + 6 * row, *quat = s.flange_quat + 8 * row;
    const double* poses = s.poses + 7 * s.objects * row;
    double* frames = s.frames + 12 * s.objects * row;
    for (int64_t k = 0; k < s.objects; ++k)
        put(Frame{vector(poses + 7 * k), from_quat(poses + 7 * k + 3)}, frames + 12 * k);
    for (int arm = 0; arm < 2; ++arm) {
        const int there = 1 - arm;
        const int64_t at = 2 * row + arm;
        const Rotation turn = from_quat(quat + 4 * arm);
        const Vector here = vector(flange_m + 3 * arm);
        put(Frame{here + s.tcp_m[arm] * turn.z, turn}, s.tools + 12 * at);
        write(rotate_back(turn, vector(flange_m + 3 * there) - here), s.other_flange + 7 * at);
        between(quat + 4 * arm, quat + 4 * there, s.other_flange + 7 * at + 3);
        const Frame object = frame(frames + 12 * s.held[arm]);
        Vector grip = rotate_back(turn, object.at + rotate(object.turn, vector(s.grip_m + 3 * at)) - here);
        grip.z -= s.tcp_m[arm];
        write(grip, s.grip_in_tool_m + 3 * at);
        const double* most = s.between_m + 3 * arm;
        const bool inside = fabs(grip.x) < most[0] && fabs(grip.y) < most[1] && fabs(grip.z) < most[2];
        s.between[at] = inside;
        const double wider_m = s.opening_m[at] - s.width_m[arm], range_m = s.most_m[arm] - s.width_m[arm];
        s.holding[at] = inside && fabs(wider_m) < s.width_margin_m;
        s.opened[at] = clamp(wider_m / range_m, 0.0, 1.0);
        s.closed[at] = larger(1.0 - fabs(wider_m) / range_m, 0.0);
        s.cleared[at] = clamp(wider_m / s.clearance_m, 0.0, 1.0);
        for (int64_t k = 0; k < s.objects; ++k) {
            const double *pose = poses + 7 * k, *product = s.quat_to_base + 16 * arm;
            double* out = s.in_bases + 7 * (at * s.objects + k);
            write(rotate(rotation(s.to_base + 9 * arm), vector(pose) - vector(s.base_m + 3 * arm)), out);
            for (int j = 0; j < 4; ++j)
                out[3 + j] = pose[3] * product[j] + pose[4] * product[4 + j] + pose[5] * product[8 + j] +
                             pose[6] * product[12 + j];
        }
    }
}

}  // namespace geometry

// Measure grasps of rows `first` to `last`.
EXPORT void grasps_measure(const Grasps* s, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) geometry::grasp(*s, row);
}

// Frames `of` each row, and those that they are compared with: their distance, chord, and the angle between their x axes.
#define FRAME_DISTANCES(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                        \
    INT(n) INT(frame_count) INT(pairs) INTS(of, pairs) REALS(frames, n * frame_count * 12) REALS(others, n * pairs * 12) \
    REALS(moved_m, n * pairs) REALS(chord, n * pairs) REALS(axis_rad, n * pairs)

STRUCTURE(FrameDistances, FRAME_DISTANCES)

EXPORT void frame_distances(const FrameDistances* s, int64_t first, int64_t last) {
    for (int64_t at = first * s->pairs; at < last * s->pairs; ++at) {
        const int64_t row = at / s->pairs, number = s->of[at % s->pairs];
        const geometry::Frame one = geometry::frame(s->frames + 12 * (s->frame_count * row + number));
        const geometry::Frame other = geometry::frame(s->others + 12 * at);
        s->moved_m[at] = geometry::length(one.at - other.at);
        s->chord[at] = geometry::length(rotation_from(one.turn, other.turn));
        const Vector a = one.turn.x, b = other.turn.x;
        s->axis_rad[at] = atan2(geometry::length(cross(a, b)), dot(a, b));
    }
}

// Frames of both tools at commanded joint positions, in the frame in which the bases are given. Of each: its step to its
// goal and the step from the `actual` tool, translations and rotations, as x / (near + |x|); and near / (near + distance)
// of the goal, as a path and as a chord.
#define ARM_TOOLS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                              \
    INT(n) REALS(links, 156) REALS(tcp_m, 2) REALS(base_m, 6) REALS(to_base, 18) REAL(near_m) REAL(near)               \
    REALS(q_rad, n * 12) REALS(tools, n * 24) REALS(actual, n * 24) REALS(saturated, n * 24) REALS(closeness, n * 4)

// Goal `goal` of each tool is a pose in frame `frame[goal]`: one of the row's, that of the cell behind the last of them,
// or, -1, that of the tool itself; then raised. Tools come to goals that are `approached` from behind, from the farther
// the farther they are beside the line, and the larger `error_m` is, the error of what they go to.
#define GOAL_STEPS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                             \
    INT(n) INT(frame_count) INT(goals) REAL(back_m) REAL(lever_m) REAL(aside) REAL(slack_m) REAL(arrived_m)            \
    REAL(arrived) REALS(scales_m, 2) REALS(scales, 2) INTS(frame, goals) REALS(pose, goals * 12)                       \
    INTS(approached, goals) REALS(further_m, goals) LINK(arms, ArmTools) REALS(tools, n * 24)                          \
    REALS(frames, n * frame_count * 12) INTS(goal, n * 2) REALS(rise_m, n * 2) REALS(error_m, n * 2)                   \
    REALS(move_m, n * 6) REALS(turn, n * 6) REALS(left_m, n * 2) REALS(chord, n * 2) REALS(away, n * 2)                \
    REALS(nearness, n * 2)

STRUCTURE(ArmTools, ARM_TOOLS)
STRUCTURE(GoalSteps, GOAL_STEPS)

namespace geometry {

inline void reach(const ArmTools& s, int64_t at) {
    const int64_t arm = at & 1;
    const Rotation to_base = rotation(s.to_base + 9 * arm);
    Frame tool;
    flange(s.links + 78 * arm, s.q_rad + 6 * at, tool.at, tool.turn, nullptr, nullptr);
    const Rotation& r = tool.turn;
    tool.turn = {rotate_back(to_base, r.x), rotate_back(to_base, r.y), rotate_back(to_base, r.z)};
    tool.at = vector(s.base_m + 3 * arm) + rotate_back(to_base, tool.at) + s.tcp_m[arm] * tool.turn.z;
    put(tool, s.tools + 12 * at);
}

inline void step(const GoalSteps& s, int64_t at) {
    constexpr Rotation same = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
    const int64_t goal = s.goal[at], number = s.frame[goal];
    const Frame tool = frame(s.tools + 12 * at), cell = {{0.0, 0.0, 0.0}, same};
    const double* frames = s.frames + 12 * s.frame_count * (at / 2);
    const Frame in = number < 0 ? tool : number == s.frame_count ? cell : frame(frames + 12 * number);
    const Frame there = in * frame(s.pose + 12 * goal);
    Vector move = there.at - tool.at;
    move.z += s.rise_m[at];
    const Vector turn = rotation_from(tool.turn, there.turn);
    const double chord = length(turn);
    double left_m = length(move) + s.further_m[goal];
    if (s.approached[goal]) {
        const Vector axis = there.turn.z, beside = move - dot(move, axis) * axis;
        const double error_m = s.aside * length(beside) + s.lever_m * chord + s.error_m[at] - s.slack_m;
        const double back_m = clamp(error_m, 0.0, s.back_m);
        move = move - back_m * axis;
        left_m = length(move) + back_m;
    }
    double sum = 2.0 - smaller(left_m, 1.0) - 0.5 * chord;
    for (int k = 0; k < 2; ++k)
        sum += 0.5 * (s.scales_m[k] / (s.scales_m[k] + left_m) + s.scales[k] / (s.scales[k] + chord));
    write(move, s.move_m + 3 * at);
    write(turn, s.turn + 3 * at);
    s.left_m[at] = left_m;
    s.chord[at] = chord;
    s.away[at] = larger(left_m / s.arrived_m, chord / s.arrived);
    s.nearness[at] = 0.25 * sum;
}

inline void saturate(Vector a, double near, double* to) { write(1.0 / (near + length(a)) * a, to); }

inline void show(const ArmTools& s, const GoalSteps& steps, int64_t at) {
    const Frame tool = frame(s.tools + 12 * at), actual = frame(s.actual + 12 * at);
    double *to = s.saturated + 12 * at, *closeness = s.closeness + 2 * at;
    saturate(vector(steps.move_m + 3 * at), s.near_m, to);
    saturate(vector(steps.turn + 3 * at), s.near, to + 3);
    saturate(tool.at - actual.at, s.near_m, to + 6);
    saturate(rotation_from(actual.turn, tool.turn), s.near, to + 9);
    closeness[0] = s.near_m / (s.near_m + steps.left_m[at]);
    closeness[1] = s.near / (s.near + steps.chord[at]);
}

}  // namespace geometry

// Compute the steps of rows `first` to `last`; with `arms`, those of the tools at joint positions.
EXPORT void goal_steps(const GoalSteps* s, int64_t first, int64_t last) {
    for (int64_t at = 2 * first; at < 2 * last; ++at) {
        if (s->arms != nullptr) geometry::reach(*s->arms, at);
        geometry::step(*s, at);
        if (s->arms != nullptr) geometry::show(*s->arms, *s, at);
    }
}

// Errors of both flanges from references, whose orientations are the same in every row; `apart_m` is that of the vector
// between the flanges. `other_flange` is the pose of the other flange in each arm's base: the row of its pose in its own
// base, with a 1 behind it, times the arm's matrix in `others`.
#define TRACKING(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                               \
    INT(n) REALS(reference_quat, 8) REALS(others, 112) REALS(flange_m, n * 6) REALS(flange_base_m, n * 6)              \
    REALS(flange_quat, n * 8) REALS(reference_m, n * 6) REALS(turn, n * 6) REALS(off_m, n * 2) REALS(chord, n * 2)     \
    REALS(apart_m, n) REALS(other_flange, n * 14)

STRUCTURE(Tracking, TRACKING)

EXPORT void track(const Tracking* s, int64_t first, int64_t last) {
    for (int64_t row = first; row < last; ++row) {
        const double *wanted = s->reference_m + 6 * row, *found = s->flange_m + 6 * row;
        const Vector left = vector(wanted) - vector(found), right = vector(wanted + 3) - vector(found + 3);
        s->apart_m[row] = geometry::length(left - right);
        for (int64_t at = 2 * row; at < 2 * row + 2; ++at) {
            const double* q = s->flange_quat + 4 * at;
            const double inverse[4] = {q[0], -q[1], -q[2], -q[3]}, *goal = s->reference_quat + 4 * (at & 1);
            const double conjugate[4] = {goal[0], -goal[1], -goal[2], -goal[3]};
            double turn[4];
            geometry::between(conjugate, inverse, turn);
            const Vector half = (turn[0] < 0.0 ? -2.0 : 2.0) * vector(turn + 1);
            write(half, s->turn + 3 * at);
            s->off_m[at] = geometry::length(at & 1 ? right : left);
            s->chord[at] = geometry::length(half);
            const double *there_m = s->flange_base_m + 3 * (at ^ 1), *there = s->flange_quat + 4 * (at ^ 1);
            const double pose[7] = {there_m[0], there_m[1], there_m[2], there[0], there[1], there[2], there[3]};
            const double* matrix = s->others + 56 * (at & 1);
            for (int j = 0; j < 7; ++j) {
                double sum = matrix[49 + j];
                for (int i = 0; i < 7; ++i) sum += pose[i] * matrix[7 * i + j];
                s->other_flange[7 * at + j] = sum;
            }
        }
    }
}
