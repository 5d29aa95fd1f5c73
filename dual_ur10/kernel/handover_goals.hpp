// Goals of both tools in each phase of a handover; see `dual_ur10.envs.tasks.handover.goals`.
#pragma once

#include "tool_goals.hpp"

// `grip_m` are positions of both grips in the block's frame, by the index of the giver. Poses are three numbers of
// position and nine of rotation, in rows: `grips`, goals of both tools in the block's frame, by the same index; the
// presented block, and the receiver's tool in the target's frame, by that index; and the tools at home.
#define HANDOVER_GOALS(INT, REAL, INTS, REALS, LINK, FUNCTION)                                                         \
    LINK(approach, Approach) REAL(leave_m) REAL(lifted_m) REAL(carried_m) REAL(meeting_m) REAL(arrived_m)              \
    REALS(grip_m, 12) REALS(grips, 48) REALS(presented, 24) REALS(laid, 24) REALS(home, 24)

STRUCTURE(HandoverGoals, HANDOVER_GOALS)

namespace goals {

// Phases, in the order in which a handover passes them. They depend on the present alone.
enum Phase { PICK, LIFT, PRESENT, TAKE, RELEASE, PLACE, LEAVE };

// What the goals of a cell depend on, in the cell frame.
struct Scene {
    int64_t giver;
    Pose block, target;
    const double *between, *holds, *width_m;  // of both arms
};

// Distance of the block from the transfer, for the rotation with a lever.
inline double off_m(const HandoverGoals& s, int64_t giver, const Pose& block) {
    const Step there = to(block, pose(s.presented + 12 * giver));
    return there.left_m + s.approach->lever_m * length(there.turn);
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
    const Pose behind = {{0.0, 0.0, -s.approach->back_m}, same};
    const bool gives = arm == scene.giver;
    const bool encloses = scene.between[arm] > 0.0 && scene.width_m[arm] < s.approach->clear_m;
    if (!gives && phase == LEAVE && encloses) return none;
    if (gives) {
        if (phase == PICK) return along(*s.approach, tool, scene.block * grip, 0.0);
        if (phase == LIFT) {
            const double up = s.carried_m - scene.block.at.z;
            return {{0.0, 0.0, up}, none.turn, up};
        }
        if (phase == PRESENT || phase == TAKE) return to(tool, shown * grip);
        if (phase != RELEASE || !encloses) return to(tool, shown * grip * behind);
        Step still = to(tool, shown * grip);
        still.left_m += s.approach->back_m;
        return still;
    }
    if (phase < TAKE) return to(tool, pose(s.home + 12 * arm));
    if (phase == RELEASE) return to(tool, shown * grip);
    if (phase == TAKE) {
        const double off = off_m(s, scene.giver, scene.block);
        return along(*s.approach, tool, (off < s.arrived_m ? scene.block : shown) * grip, off);
    }
    const Pose laid = scene.target * pose(s.laid + 12 * scene.giver);
    return phase == LEAVE ? to(tool, laid * behind) : along(*s.approach, tool, laid, 0.0);
}

// True for a gripper that is to be closed.
inline bool closes(const HandoverGoals& s, const Scene& scene, Phase phase, int64_t arm, const Step& step) {
    const bool gives = arm == scene.giver;
    if (phase == (gives ? PICK : TAKE))
        return grasps_at(*s.approach, step, scene.between[arm] > 0.0, scene.width_m[arm]);
    if (gives) return phase < RELEASE;
    return phase == RELEASE || (phase == PLACE && !is_there(*s.approach, step, 1.0));
}

}  // namespace goals
