// Goals of both tools in each phase of a handover; see `dual_ur10.envs.tasks.handover.goals`.
#pragma once

#include "forward.hpp"
#include "grasps.hpp"

// `grip_m` are positions of both grips in the block's frame, by the index of the giver. Poses are three numbers of
// position and nine of rotation, in rows: `grips`, goals of both tools in the block's frame, by the same index; the
// presented block, and the receiver's tool in the target's frame, by that index; and the tools at home.
#define HANDOVER_GOALS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                         \
    REAL(tcp_m) REAL(leave_m) REAL(clear_m) REAL(lifted_m) REAL(carried_m) REAL(meeting_m) REAL(back_m)                \
    REAL(lever_m) REAL(aside) REAL(slack_m) REAL(arrived_m) REAL(there_m) REAL(there) REAL(keep) REALS(scales_m, 2)    \
    REALS(scales, 2) REALS(grip_m, 12) REALS(grips, 48) REALS(presented, 24) REALS(laid, 24) REALS(home, 24)

STRUCTURE(HandoverGoals, HANDOVER_GOALS)

namespace goals {

struct Pose {
    Vector at;
    Rotation turn;
};

inline Pose pose(const double* from) { return {vector(from), rotation(from + 3)}; }
inline Pose pose(const double* at, const double* quat) { return {vector(at), grasps::from_quat(quat)}; }
inline Pose operator*(const Pose& a, const Pose& b) { return {a.at + rotate(a.turn, b.at), a.turn * b.turn}; }
inline Pose tool_of(const HandoverGoals& s, const Pose& flange) {
    return {flange.at + s.tcp_m * flange.turn.z, flange.turn};
}
inline double length(Vector a) { return sqrt(squared(a)); }

// Phases, in the order in which a handover passes them. They depend on the present alone.
enum Phase { PICK, LIFT, PRESENT, TAKE, RELEASE, PLACE, LEAVE };

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
inline Step along(const HandoverGoals& s, const Pose& tool, const Pose& goal, double off_m) {
    Step found = to(tool, goal);
    const Vector axis = goal.turn.z;
    const Vector beside = found.move - dot(found.move, axis) * axis;
    const double error_m = s.aside * length(beside) + s.lever_m * length(found.turn) + off_m - s.slack_m;
    const double back_m = clamp(error_m, 0.0, s.back_m);
    found.move = found.move - back_m * axis;
    found.left_m = length(found.move) + back_m;
    return found;
}

// What the goals of a cell depend on, in the cell frame.
struct Scene {
    int64_t giver;
    Pose block, target;
    const double *between, *holds, *width_m;  // of both arms
};

// Distance of the block from the transfer, for the rotation with a lever.
inline double off_m(const HandoverGoals& s, int64_t giver, const Pose& block) {
    const Step there = to(block, pose(s.presented + 12 * giver));
    return there.left_m + s.lever_m * length(there.turn);
}

// A gripper that has begun to open still encloses the block, until it has left it: only then may the block move.
inline Phase phase(const HandoverGoals& s, const Scene& scene) {
    const int64_t giver = scene.giver, receiver = 1 - giver;
    if (scene.holds[receiver] > 0.0) return scene.between[giver] > 0.0 ? RELEASE : PLACE;
    if (!(scene.holds[giver] > 0.0)) return length(scene.block.at - scene.target.at) < s.leave_m ? LEAVE : PICK;
    if (scene.block.at.z <= s.lifted_m) return LIFT;
    return off_m(s, giver, scene.block) < s.meeting_m ? TAKE : PRESENT;
}

inline Step step(const HandoverGoals& s, const Scene& scene, Phase phase, int64_t arm, const Pose& tool) {
    constexpr Rotation same = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
    constexpr Step none = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}, 0.0};
    const Pose grip = pose(s.grips + 24 * scene.giver + 12 * arm), shown = pose(s.presented + 12 * scene.giver);
    const Pose behind = {{0.0, 0.0, -s.back_m}, same};
    const bool gives = arm == scene.giver, encloses = scene.between[arm] > 0.0 && scene.width_m[arm] < s.clear_m;
    if (!gives && phase == LEAVE && encloses) return none;
    if (gives) {
        if (phase == PICK) return along(s, tool, scene.block * grip, 0.0);
        if (phase == LIFT) {
            const double up = s.carried_m - scene.block.at.z;
            return {{0.0, 0.0, up}, none.turn, up};
        }
        if (phase == PRESENT || phase == TAKE) return to(tool, shown * grip);
        if (phase != RELEASE || !encloses) return to(tool, shown * grip * behind);
        Step still = to(tool, shown * grip);
        still.left_m += s.back_m;
        return still;
    }
    if (phase < TAKE) return to(tool, pose(s.home + 12 * arm));
    if (phase == RELEASE) return to(tool, shown * grip);
    if (phase == TAKE) {
        const double off = off_m(s, scene.giver, scene.block);
        return along(s, tool, (off < s.arrived_m ? scene.block : shown) * grip, off);
    }
    const Pose laid = scene.target * pose(s.laid + 12 * scene.giver);
    return phase == LEAVE ? to(tool, laid * behind) : along(s, tool, laid, 0.0);
}

inline bool is_there(const HandoverGoals& s, const Step& step, double tolerance) {
    return step.left_m < tolerance * s.there_m && length(step.turn) < tolerance * s.there;
}

// True for a gripper that is to be closed. Fingers that have begun to close go on at a larger error.
inline bool closes(const HandoverGoals& s, const Scene& scene, Phase phase, int64_t arm, const Step& step) {
    const bool gives = arm == scene.giver;
    if (phase == (gives ? PICK : TAKE))
        return scene.between[arm] > 0.0 && is_there(s, step, scene.width_m[arm] < s.clear_m ? s.keep : 1.0);
    if (gives) return phase < RELEASE;
    return phase == RELEASE || (phase == PLACE && !is_there(s, step, 1.0));
}

// 1 at the goal; it falls at every distance.
inline double nearness(const HandoverGoals& s, const Step& step) {
    const double turn = length(step.turn);
    double move = 1.0 - smaller(step.left_m, 1.0), rotation = 1.0 - 0.5 * turn;
    for (int k = 0; k < 2; ++k) {
        move += 0.5 * s.scales_m[k] / (s.scales_m[k] + step.left_m);
        rotation += 0.5 * s.scales[k] / (s.scales[k] + turn);
    }
    return 0.25 * (move + rotation);
}

}  // namespace goals
