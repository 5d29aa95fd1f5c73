"""Cheats of the tasks in `dual_ur10.tasks`: ways round a task that must not succeed, each written by hand for it.

    python benchmarks/cheats.py BoxLift

A cheat is a coroutine like a script. It follows the task's own script, as far as it serves, and then goes its own way;
a refused motion does not end its episode.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Generator
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from dual_ur10 import tasks as ur
from dual_ur10.ids import env_id_of
from dual_ur10.policies import load
from dual_ur10.tasks.box_lift import tools_at
from dual_ur10.tasks.lid_and_place import LidScript

Cheat = Callable[[Any, ur.Motions], ur.Steps]
Arms = Generator[ur.Wish, ur.Fields, ur.Motions]
LEFT, RIGHT = np.array([1.0, 0.0]), np.array([0.0, 1.0])
UP = np.array([0.0, 0.0, 1.0])


def until(script: Any, arms: ur.Motions, over: Callable[[], Any]) -> Arms:
    """Follow the task's own script until a condition is true; return the motions of both arms from there."""
    steps = type(script).script(script, arms.fields)
    wish = next(steps)
    while not over():
        arms.fields = yield wish
        try:
            wish = steps.send(arms.fields)
        except StopIteration:
            break
    found = ur.Motions(script, arms.fields)
    found.opening = wish.opening
    return found


def passed(script: Any, stages: int) -> Callable[[], bool]:
    """Return the condition that an episode has passed so many stages."""
    return lambda: script.stage >= stages


def moved(arms: ur.Motions, path_m: Any, speed_m_s: float = 0.15) -> ur.Steps:
    """Move both tools by paths, (3,) or (2, 3)."""
    yield from arms.line(ur.Poses(arms.tools.position_m + path_m, arms.tools.quat), speed_m_s)


def changed(script: Any, arms: ur.Motions, change: Callable[[ur.Wish], ur.Wish]) -> ur.Steps:
    """Follow the task's own script with other wishes."""
    steps = type(script).script(script, arms.fields)
    wish = next(steps)
    while True:
        fields = yield change(wish)
        try:
            wish = steps.send(fields)
        except StopIteration:
            return


def alone(arm: int) -> Cheat:
    """Return the cheat of one arm; the other one rests at home with an open gripper."""

    def cheat(script: Any, arms: ur.Motions) -> ur.Steps:
        home = arms.q_rad[1 - arm].copy()

        def change(wish: ur.Wish) -> ur.Wish:
            q_rad, opening = wish.q_rad.copy(), np.array(wish.opening)
            q_rad[1 - arm], opening[1 - arm] = home, 1.0
            return ur.Wish(q_rad, opening)

        yield from changed(script, arms, change)

    return cheat


def gripping(least: tuple[float | None, float | None]) -> Cheat:
    """Return the cheat of both arms with grippers that close no farther than to openings, or as the script does."""
    bound = np.array([-1.0 if each is None else each for each in least])
    return lambda script, arms: changed(
        script, arms, lambda wish: ur.Wish(wish.q_rad, np.maximum(np.asarray(wish.opening), bound))
    )


def surrounding(left: bool, right: bool) -> Cheat:
    """Return the cheat of grippers whose fingers are about their objects, and do not press them."""

    def cheat(script: Any, arms: ur.Motions) -> ur.Steps:
        grips = script.task.grips
        least = [2.0 * (grip.width_m + 8e-4) / 0.085 - 1.0 for grip in grips]
        yield from gripping((least[0] if left else None, least[1] if right else None))(script, arms)

    return cheat


def released(stages: int, which: Any, path_m: Any = 0.0) -> Cheat:
    """Return the cheat that opens grippers after so many stages, while both tools move."""

    def cheat(script: Any, arms: ur.Motions) -> ur.Steps:
        arms = yield from until(script, arms, passed(script, stages))
        arms.opening = np.where(which, 1.0, np.asarray(arms.opening))
        yield from moved(arms, path_m, 0.5)
        yield from arms.hold(1.0)

    return cheat


COMMON: dict[str, Cheat] = {
    "left arm alone": alone(0),
    "right arm alone": alone(1),
    "no gripper closes": gripping((1.0, 1.0)),
    "only the left gripper closes": gripping((None, 1.0)),
    "only the right gripper closes": gripping((1.0, None)),
}
SURROUNDING: dict[str, Cheat] = {
    "fingers about both objects": surrounding(True, True),
    "left fingers about the object": surrounding(True, False),
    "right fingers about the object": surrounding(False, True),
}


def beside(script: Any, arms: ur.Motions) -> ur.Steps:
    """Tilt the peg beside the plate, so that its tip is below the hole."""
    arms = yield from until(script, arms, passed(script, 3))
    yield from moved(arms, LEFT[:, None] * [0.0, 0.0, 0.1])
    yield from moved(arms, LEFT[:, None] * [0.0, 0.16, 0.0])
    yield from moved(arms, LEFT[:, None] * [0.0, 0.0, -0.14])
    turn = ur.quat_from_rotvec(np.array([[-0.9, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    yield from arms.line(ur.Poses(arms.tools.position_m, ur.quat_multiply(turn, arms.tools.quat)))
    for _ in range(200):
        path_m = arms.pose("plate_base").position_m - [0.0, 0.0, 0.05]
        peg = arms.pose("peg_base")
        path_m = path_m - (peg.position_m + ur.rotate(peg.quat, [0.0, 0.0, -0.06]))
        goal = ur.Poses(arms.tools.position_m + LEFT[:, None] * path_m, arms.tools.quat)
        yield from arms.follow(goal)


def on_the_table(script: Any, arms: ur.Motions) -> ur.Steps:
    """Lower both after they are aligned, so that the plate lies on the table with the peg above the hole."""
    arms = yield from until(script, arms, passed(script, 3))
    yield from moved(arms, -0.19 * UP)
    yield from moved(arms, LEFT[:, None] * -0.04 * UP, 0.03)


def pushed_by_the_plate(script: Any, arms: ur.Motions) -> ur.Steps:
    """Hold the peg still, and push the plate over it from below, off its axis."""
    arms = yield from until(script, arms, passed(script, 2))
    yield from moved(arms, np.array([[0.0, 0.0, 0.0], [0.0, 0.25, 0.0]]))
    yield from moved(arms, RIGHT[:, None] * 0.1 * UP)


PEG: dict[str, Cheat] = {
    **COMMON,
    **SURROUNDING,
    "tip beside the plate": beside,
    "peg dropped into the hole": released(3, LEFT),
    "plate dropped over the peg": released(3, RIGHT),
    "peg thrown at the plate": released(2, LEFT, LEFT[:, None] * [0.0, -0.2, 0.0]),
    "plate on the table": on_the_table,
    "peg pushed by the plate": pushed_by_the_plate,
}


def low(script: Any, arms: ur.Motions) -> ur.Steps:
    """Move the tray to below its goal, a centimetre above the table."""
    arms = yield from until(script, arms, passed(script, 1))
    yield from moved(arms, 0.01 * UP, 0.05)
    path_m = arms.pose("goal_base").position_m - arms.pose("tray_base").position_m
    yield from moved(arms, path_m * [1.0, 1.0, 0.0], 0.05)


def then_slides(script: Any, arms: ur.Motions) -> ur.Steps:
    """Lift the tray, lay it down again, and push it along the table."""
    arms = yield from until(script, arms, passed(script, 2))
    height_m = arms.pose("tray_base").position_m[2] - 0.02
    yield from moved(arms, -height_m * UP, 0.05)
    path_m = arms.pose("goal_base").position_m - arms.pose("tray_base").position_m
    yield from moved(arms, path_m * [1.0, 1.0, 0.0], 0.05)


def tossed(script: Any, arms: ur.Motions) -> ur.Steps:
    """Throw the tray up to its goal."""
    arms = yield from until(script, arms, passed(script, 1))
    yield from moved(arms, 0.1 * UP, 0.6)
    arms.opening = np.ones(2)
    yield from moved(arms, 0.1 * UP, 0.6)
    yield from arms.hold(1.0)


TRAY: dict[str, Cheat] = {
    **COMMON,
    **SURROUNDING,
    "tray carried low": low,
    "tray lifted, then slid": then_slides,
    "tray thrown": tossed,
    "left gripper lets go in the air": released(2, LEFT),
    "right gripper lets go in the air": released(2, RIGHT),
    "tray dropped at the goal": released(3, LEFT + RIGHT),
}


def pressed_along(script: Any, arms: ur.Motions, goal_m: Any, turn_rad: float, time_s: float) -> ur.Steps:
    """Move a box that both arms press, with the forces of the script."""
    begin, yielding = arms.pose("box_base"), ur.Admittance(arms, 1e-4)
    tools = ur.compose(begin, tools_at(script.settings.width_m, -0.015))
    yielding.moved_m = ur.rotate(ur.quat_conjugate(tools.quat), arms.tools.position_m - tools.position_m)
    yielding.force_n = np.array([[0.0, 0.0, -42.0]] * 2)
    steps = int(time_s / arms.period_s)
    for ratio in ur.least_jerk(np.arange(1, steps + 1) / steps):
        quat = ur.quat_multiply(ur.yaw_quat(np.array(ratio * turn_rad)), begin.quat)
        yield from script.press(yielding, ur.Poses(begin.position_m + ratio * (goal_m - begin.position_m), quat))


def slides(lift_m: float) -> Cheat:
    """Return the cheat that pushes the pressed box along the table to its goal, after it was lifted where it stood."""

    def cheat(script: Any, arms: ur.Motions) -> ur.Steps:
        begin, goal = arms.pose("box_base"), arms.pose("goal_base", 0.1)
        turn_rad = 2.0 * np.arctan(np.divide(*ur.relative_to(begin, goal).quat[[3, 0]]))
        arms = yield from until(script, arms, lambda: arms.pose("box_base").position_m[2] > 0.101)
        yield from pressed_along(script, arms, begin.position_m + lift_m * UP, 0.0, 2.0)
        yield from pressed_along(script, arms, begin.position_m, 0.0, 2.0)
        yield from pressed_along(script, arms, goal.position_m, turn_rad, 6.0)
        yield from leave(script, arms)

    return cheat


def leave(script: Any, arms: ur.Motions) -> ur.Steps:
    """Take both grippers from the box."""
    back_m = ur.rotate(arms.tools.quat, np.array([0.0, 0.0, -0.06]))
    yield from moved(arms, back_m, 0.05)
    yield from arms.hold(1.0)


def dropped(script: Any, arms: ur.Motions) -> ur.Steps:
    """Let the box fall on its goal."""
    arms = yield from until(script, arms, passed(script, 3))
    yield from arms.hold(2.5)
    yield from moved(arms, ur.rotate(arms.tools.quat, np.array([0.0, 0.0, -0.06])), 0.5)


def thrown(script: Any, arms: ur.Motions) -> ur.Steps:
    """Throw the box towards its goal."""
    arms = yield from until(script, arms, lambda: arms.pose("box_base").position_m[2] > 0.15)
    path_m = arms.pose("goal_base").position_m - arms.pose("box_base").position_m
    yield from moved(arms, 0.5 * path_m * [1.0, 1.0, 0.0], 0.6)
    yield from moved(arms, ur.rotate(arms.tools.quat, np.array([0.0, 0.0, -0.06])), 0.6)


def pushed(arm: int) -> Cheat:
    """Return the cheat of one arm that pushes the box towards its goal after both have pressed it."""

    def cheat(script: Any, arms: ur.Motions) -> ur.Steps:
        arms = yield from until(script, arms, passed(script, 2))
        other = np.eye(2)[1 - arm][:, None]
        yield from moved(arms, other * ur.rotate(arms.tools.quat, np.array([0.0, 0.0, -0.1])))
        path_m = arms.pose("goal_base").position_m - arms.pose("box_base").position_m
        yield from moved(arms, np.eye(2)[arm][:, None] * path_m * [1.0, 1.0, 0.0], 0.05)
        yield from leave(script, arms)

    return cheat


def held_above(script: Any, arms: ur.Motions) -> ur.Steps:
    """Hold the box above its goal for ever."""
    arms = yield from until(script, arms, passed(script, 3))
    yield from arms.hold(1.0)


def scooped(script: Any, arms: ur.Motions) -> ur.Steps:
    """Press the box with the left arm alone, against a right arm that rests at its other face."""
    arms = yield from until(script, arms, passed(script, 1))
    box = arms.pose("box_base", 0.1)
    yield from arms.line(ur.compose(box, tools_at(script.settings.width_m, np.array([0.004, 0.0]))), 0.02)
    yield from moved(arms, 0.12 * UP, 0.05)


BOX: dict[str, Cheat] = {
    "left arm alone": alone(0),
    "right arm alone": alone(1),
    "grippers open": gripping((1.0, 1.0)),
    "slid along the table": slides(0.0),
    "lifted, then slid": slides(0.1),
    "dropped on its goal": dropped,
    "thrown": thrown,
    "pushed by the left arm": pushed(0),
    "pushed by the right arm": pushed(1),
    "held above its goal": held_above,
    "pressed by the left arm alone": scooped,
}


def block_falls(height: int) -> Cheat:
    """Return the cheat that lets the block fall: 0 from over the case, 1 from where it was lifted, towards the case."""

    def cheat(script: Any, arms: ur.Motions) -> ur.Steps:
        arms = yield from until(script, arms, passed(script, 2))
        if height == 0:
            case = arms.pose("case_base").position_m
            path_m = (case - arms.pose("block_base").position_m) * [1.0, 1.0, 0.0]
            yield from moved(arms, RIGHT[:, None] * path_m, 0.1)
            yield from arms.grip(-1.0, 1.0)
        else:
            arms.opening = np.array([-1.0, 1.0])
            yield from moved(arms, RIGHT[:, None] * [0.0, 0.2, 0.1], 0.8)
        yield from closed(script, arms)

    return cheat


def closed(script: Any, arms: ur.Motions, gone: bool = True) -> ur.Steps:
    """Close the lid as the script does, with the right arm away."""
    if gone:
        yield from moved(arms, RIGHT[:, None] * 0.15 * UP)
        yield from moved(arms, RIGHT[:, None] * [0.0, -0.2, 0.0])
    case, right = arms.pose("case_base", 0.0), ur.Poses(arms.tools.position_m[1], arms.tools.quat[1])
    for ratio in ur.least_jerk(np.arange(1, 151) / 150):
        yield from arms.step(ur.pair(LidScript.tab(case, 1.6 - 1.58 * ratio), right))
    yield from arms.grip(1.0, float(np.asarray(arms.opening)[1]))


def kept(script: Any, arms: ur.Motions) -> ur.Steps:
    """Hold the block in the case while the lid closes on the gripper."""
    arms = yield from until(script, arms, lambda: script.stage == 2 and arms.pose("block_base").position_m[2] < 0.044)
    yield from closed(script, arms, gone=False)


def taken_out(script: Any, arms: ur.Motions) -> ur.Steps:
    """Put the block into the case, take it out again, and close the lid."""
    arms = yield from until(script, arms, passed(script, 3))
    yield from arms.grip(-1.0)
    yield from closed(script, arms)
    yield from arms.grip(1.0)


def let_go(stages: int) -> Cheat:
    """Return the cheat that lets go of the lid after so many stages."""
    return released(stages, LEFT)


def half_closed(script: Any, arms: ur.Motions) -> ur.Steps:
    """Let go of a lid that is half closed."""
    arms = yield from until(script, arms, lambda: script.stage == 3 and arms.fields["lid_rad"][0, 0] < 0.6)
    yield from arms.grip(1.0)


def propped(script: Any, arms: ur.Motions) -> ur.Steps:
    """Hold the block below the open lid, and let go of the lid, so that the block holds it."""
    arms = yield from until(script, arms, passed(script, 2))
    path_m = arms.pose("case_base").position_m + 0.12 * UP - arms.pose("block_base").position_m
    yield from moved(arms, RIGHT[:, None] * path_m)
    yield from arms.grip(1.0, -1.0)


def outside(script: Any, arms: ur.Motions) -> ur.Steps:
    """Put the block down beside the case, and close the lid."""
    arms = yield from until(script, arms, passed(script, 2))
    height_m = arms.pose("block_base").position_m[2] - 0.035
    yield from moved(arms, RIGHT[:, None] * -height_m * UP)
    yield from arms.grip(-1.0, 0.3)
    yield from closed(script, arms)


LID: dict[str, Cheat] = {
    **COMMON,
    **SURROUNDING,
    "block dropped into the case": block_falls(0),
    "block thrown": block_falls(1),
    "block kept in the hand": kept,
    "block taken out again": taken_out,
    "block beside the case": outside,
    "lid let go of when open": let_go(2),
    "lid let go of over the block": let_go(3),
    "lid let go of half closed": half_closed,
    "lid propped by the block": propped,
}
CHEATS: dict[str, dict[str, Cheat]] = {
    "PegInsertion": PEG,
    "TrayBalance": TRAY,
    "BoxLift": BOX,
    "LidAndPlace": LID,
}
"""Cheats of each task by name; those of one arm alone are called so."""


def tried(env_id: str, cheats: dict[str, Cheat], seed: int = 0) -> dict[str, tuple[bool, int, str]]:
    """Run cheats of a task at once, all with the same seed; return each one's success, stage and reason of its end."""
    scripts: list[Any] = [load("scripted", env_id) for _ in cheats]
    for script, cheat in zip(scripts, cheats.values(), strict=True):
        script.script = partial(lambda own, act, fields: act(own, ur.Motions(own, fields)), script, cheat)
        script.stage = 0
    found: dict[int, tuple[bool, int, str]] = {}
    env: Any = gym.make_vec(
        env_id, len(cheats), "vector_entry_point", autoreset_mode="Disabled", on_refusal="brake", randomization="none"
    )
    try:
        observation, _ = env.reset(seed=[seed] * len(cheats))
        while len(found) < len(cheats):
            rest = np.zeros(env.single_action_space.shape)
            actions = [rest if row in found else scripts[row](observation[row]) for row in range(len(cheats))]
            observation, _, terminated, truncated, info = env.step(np.array(actions, dtype=np.float32))
            for row, script in enumerate(scripts):
                script.stage = int(info["stage"][row])
                if row not in found and (terminated[row] or truncated[row]):
                    found[row] = bool(info["is_success"][row]), script.stage, str(info["end_reason"][row])
            if (ended := terminated | truncated).any():
                observation, _ = env.reset(seed=[seed] * len(cheats), options={"reset_mask": ended})
    finally:
        env.close()
    return {name: found[row] for row, name in enumerate(cheats)}


def main() -> None:
    """Try the cheats of a task from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="*", default=[*CHEATS], help="name of a task; default: all")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for task in arguments.task:
        for name, (success, stage, reason) in tried(env_id_of(task), CHEATS[task], arguments.seed).items():
            print(f"{task}: {name}: {'SUCCESS' if success else reason}, {stage} stages passed", flush=True)


if __name__ == "__main__":
    main()
