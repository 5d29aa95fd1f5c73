"""Tables in the docstring of a task, in Gymnasium's form, written from its limits, layout and settings."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any, Final

from dual_ur10.assets.settings import DEFAULT_TOOLS, HOME_Q_RAD
from dual_ur10.envs.tasks.observation_layout import ConciseView

_PERIOD_S: Final = 0.04  # of the default rate, 25 Hz
_JOINTS: Final = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
_PLACE: Final = re.compile(r"^( *)\{(actions|observations|arguments)\}$", re.MULTILINE)
_COLUMNS: Final = "| Num | Observation | Min | Max | Name (in XML file) | Type (Unit) |\n|---|---|---|---|---|---|"


def described(doc: str, task: Any) -> str:
    """Return the docstring of a task with its tables.

    Lines that hold `{actions}`, `{observations}` or `{arguments}` alone stand for them.

    Args:
        doc: The docstring.
        task: The subclass of `Task`, with `limits`, `layout` and `settings_type`; its arms have grippers.
    """

    def table(place: re.Match[str]) -> str:
        lines = "\n".join(_TABLES[place[2]](task)).splitlines()
        return "\n".join(f"{place[1]}{line}".rstrip() for line in lines)

    return _PLACE.sub(table, doc)


def _actions(task: Any) -> Iterator[str]:
    speed_rad_s, stroke_m = task.limits.speed_rad_s[0], DEFAULT_TOOLS[0].stroke_m
    yield (
        'The action space is a `Box(-1.0, 1.0, (14,), float32)` with the default `action_mode="joint_delta"`: steps\n'
        f"of the six joints of an arm from the last command, in fractions of the speed limit ({speed_rad_s:g} rad/s)\n"
        f"times the period ({1e3 * _PERIOD_S:g} ms), and the opening of its gripper.\n\n"
        "The table shows the left arm; the right arm's numbers follow in the same order.\n"
    )
    yield "| Num | Action | Control Min | Control Max | Name (in XML file) | Joint | Type (Unit) |"
    yield "|---|---|---|---|---|---|---|"
    step = f"fraction of {speed_rad_s * _PERIOD_S:.3f} (rad)"
    for number, joint in enumerate(_JOINTS):
        yield f"| {number} | step of the {joint.replace('_', ' ')} | -1 | 1 | left/{joint}_joint | hinge | {step} |"
    yield f"| 6 | opening of the gripper | -1 | 1 | left/gripper | tendon | -1 is 0, 1 is {stroke_m:g} (m) |"


def _observations(task: Any) -> Iterator[str]:
    layout, size = task.layout, task.layout.size
    concise = ConciseView(layout, HOME_Q_RAD, task.__name__).layout
    yield (
        f"The observation space is a `Box(low, high, ({2 * size},), float64)` with the bounds of the table: {size}\n"
        f"numbers of the left arm, which the table shows, then the same {size} of the right arm, with left and right\n"
        "exchanged. All of them can be measured on a real cell. Poses, forces and torques are in the arm's own\n"
        "`base` frame unless another is named; quaternions are (w, x, y, z). The weight of the gripper is subtracted\n"
        "from the force, which has the noise of `CellConfig.wrench_noise`.\n"
    )
    yield _COLUMNS
    yield from layout.table()
    yield (
        "\nAn agent of the two-agent environment observes its arm's numbers.\n\n"
        'With `observation="goals"` the observation space is a\n'
        f"`Box(-1.0, 1.0, ({2 * concise.size},), float32)`: {concise.size} numbers of the left arm, then those of the\n"
        "right arm. A value x is shown as x / (u + abs(x)), in each unit u that the table names\n"
        "(`dual_ur10.envs.tasks.observation_layout.ConciseView`).\n"
    )
    yield _COLUMNS
    yield from concise.table()


def _arguments(task: Any) -> Iterator[str]:
    settings = task.settings_type
    texts = dict(re.findall(r"^ *(\w+): (.+(?:\n {8,}.+)*)$", inspect.getdoc(settings) or "", re.MULTILINE))
    yield "| Parameter | Type | Default | Description |"
    yield "|---|---|---|---|"
    for field in dataclasses.fields(settings):
        kind = field.type if isinstance(field.type, str) else field.type.__name__
        text = " ".join(texts.get(field.name, "").split())
        yield f"| `{field.name}` | {kind} | `{field.default!r}` | {text} |"
    yield "\nThose of every environment are described in `dual_ur10.envs.core.options.EnvOptions`."


_TABLES: Final[dict[str, Callable[[Any], Iterator[str]]]] = {
    "actions": _actions,
    "observations": _observations,
    "arguments": _arguments,
}
