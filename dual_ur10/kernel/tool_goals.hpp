// Goals of tools that handle an object, and what agents observe of them; see `dual_ur10.envs.tasks.tool_goals`.
#pragma once

#include "forward.hpp"
#include "grasps.hpp"

// How tools come to grips: `tcp_m`, distance of each tool from its flange; `width_m`, opening at which fingers touch the
// object, and `clear_m`, at which they are clear of it.
#define APPROACH(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                               \
    REALS(tcp_m, 2) REAL(width_m) REAL(clear_m) REALS(opening_m, 2) REAL(back_m) REAL(lever_m) REAL(aside)         \
    REAL(slack_m) REAL(there_m) REAL(there) REAL(keep) REALS(scales_m, 2) REALS(scales, 2)

// Where the fields of an arm begin among the `size` numbers of its observation (`gripper`: -1 without grippers), both
// chains and bases, and the scales of what agents observe.
#define TOOL_FIELDS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                            \
    INT(size) INT(commanded) INT(flange) INT(gripper) REAL(near_m) REAL(near) REALS(links, 156)                        \
    REALS(base_m, 6) REALS(to_base, 18) LINK(grips, GraspLimits)

STRUCTURE(Approach, APPROACH)
STRUCTURE(ToolFields, TOOL_FIELDS)

namespace goals {

struct Pose {
    Vector at;
    Rotation turn;
};

inline Pose pose(const double* from) { return {vector(from), rotation(from + 3)}; }
inline Pose pose(const double* at, const double* quat) { return {vector(at), grasps::from_quat(quat)}; }
inline Pose operator*(const Pose& a, const Pose& b) { return {a.at + rotate(a.turn, b.at), a.turn * b.turn}; }
inline Pose tool_of(const Approach& s, int64_t arm, const Pose& flange) {
    return {flange.at + s.tcp_m[arm] * flange.turn.z, flange.turn};
}
inline double length(Vector a) { return sqrt(squared(a)); }

// Largest width that both tools have.
inline double most(const Approach& s) { return smaller(s.opening_m[0], s.opening_m[1]); }

// Step of a tool to its goal: translation, and twice the vector part of the rotation's quaternion; `left_m` is the
// length of the way to the end of the phase.
struct Step {
    Vector move, turn;
    double left_m;
};

inline Step to(const Pose& tool, const Pose& goal) {
    const Vector move = goal.at - tool.at;
    return {move, rotation_from(tool.turn, goal.turn), length(move)};
}

// As `to`, but to a point behind the goal along its own z, the farther the worse the tool is aligned with it, so that
// fingers pass an object on both sides. `off_m` is an error of what it goes to.
inline Step along(const Approach& s, const Pose& tool, const Pose& goal, double off_m) {
    Step found = to(tool, goal);
    const Vector axis = goal.turn.z;
    const Vector beside = found.move - dot(found.move, axis) * axis;
    const double error_m = s.aside * length(beside) + s.lever_m * length(found.turn) + off_m - s.slack_m;
    const double back_m = clamp(error_m, 0.0, s.back_m);
    found.move = found.move - back_m * axis;
    found.left_m = length(found.move) + back_m;
    return found;
}

inline bool is_there(const Approach& s, const Step& step, double tolerance) {
    return step.left_m < tolerance * s.there_m && length(step.turn) < tolerance * s.there;
}

// True for fingers that have to close at a grip. Those that have begun to go on at a larger error.
inline bool grasps_at(const Approach& s, const Step& step, bool between, double width_m) {
    return between && is_there(s, step, width_m < s.clear_m ? s.keep : 1.0);
}

// 1 at the goal; it falls at every distance.
inline double nearness(const Approach& s, const Step& step) {
    const double turn = length(step.turn);
    double move = 1.0 - smaller(step.left_m, 1.0), rotation = 1.0 - 0.5 * turn;
    for (int k = 0; k < 2; ++k) {
        move += 0.5 * s.scales_m[k] / (s.scales_m[k] + step.left_m);
        rotation += 0.5 * s.scales[k] / (s.scales[k] + turn);
    }
    return 0.25 * (move + rotation);
}

// What a nearness counts for with open fingers that are not to close: 1 once they are open.
inline double opened(const Approach& s, double width_m) {
    return 0.8 + 0.2 * clamp((width_m - s.width_m) / (most(s) - s.width_m), 0.0, 1.0);
}

// 1 for fingers at the object's width, 0 fully open or closed beyond it.
inline double closed(const Approach& s, double width_m) {
    return larger(1.0 - fabs(width_m - s.width_m) / (most(s) - s.width_m), 0.0);
}

// One row of joint observations, in the cell frame.
struct Seen {
    const ToolFields& s;
    const double* both;

    double number(int64_t arm, int64_t field) const { return both[arm * s.size + field]; }
    Pose in_cell(int64_t arm, const Pose& pose) const {
        const Rotation to_base = rotation(s.to_base + 9 * arm);
        const Rotation& r = pose.turn;
        return {vector(s.base_m + 3 * arm) + rotate_back(to_base, pose.at),
                {rotate_back(to_base, r.x), rotate_back(to_base, r.y), rotate_back(to_base, r.z)}};
    }
    Pose at(int64_t arm, int64_t field) const {
        const double* numbers = both + arm * s.size + field;
        return in_cell(arm, pose(numbers, numbers + 3));
    }
    Pose commanded(int64_t arm) const {
        Pose found;
        flange(s.links + 78 * arm, both + arm * s.size + s.commanded, found.at, found.turn, nullptr, nullptr);
        return in_cell(arm, found);
    }
};

// What an arm has of an object with a grip there.
struct Grip {
    bool between, holds;
    double width_m;
};

inline Grip grip(const Approach& s, const Seen& seen, int64_t arm, Vector grip_m) {
    if (seen.s.gripper < 0) return {true, true, 0.0};  // welded
    const Pose flange = seen.at(arm, seen.s.flange);
    const Vector away = grasps::in_tool(flange.turn, flange.at, s.tcp_m[arm], grip_m);
    const double width_m = seen.number(arm, seen.s.gripper);
    return {grasps::is_between(*seen.s.grips, arm, away), grasps::holds(*seen.s.grips, arm, away, width_m), width_m};
}

// Write what an agent observes: the numbers of its arm, and behind them the goals' fields, in their order.
inline void write_fields(const Approach& approach, const Seen& seen, int64_t arm, const Pose& tool, const Step& step,
                         const Grip& grip, bool closes, double* own) {
    const ToolFields& s = seen.s;
    copy(own, seen.both + arm * s.size, s.size);
    double* more = own + s.size;
    const Step lag = to(tool_of(approach, arm, seen.at(arm, s.flange)), tool);
    const auto near = [](Vector v, double scale) { return (1.0 / (scale + length(v))) * v; };
    write(step.move, more);
    write(step.turn, more + 3);
    write(near(step.move, s.near_m), more + 6);
    write(near(step.turn, s.near), more + 9);
    write(near(lag.move, s.near_m), more + 12);
    write(near(lag.turn, s.near), more + 15);
    more += 18;
    if (s.gripper >= 0) {
        more[0] = grip.between;
        more[1] = grip.width_m / approach.opening_m[arm];
        more[2] = !closes;
        more += 3;
    }
    more[0] = s.near_m / (s.near_m + step.left_m);
    more[1] = s.near / (s.near + length(step.turn));
}

}  // namespace goals
