"""Template of a new cell file, and the reference page of all keys."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any, Final

from dual_ur10.assets.settings import default_mount
from dual_ur10.errors import CellFileError, DualUR10Error
from dual_ur10.sim2real.cell_file.cell_file import (
    FIRST_SPEED_FACTOR,
    FIRST_SPEED_RAD_S,
    FIRST_TCP_SPEED_M_S,
    MAX_BYTES,
    MAX_DOTS,
    examine_text,
    keys,
)
from dual_ur10.sim2real.cell_file.tables import MAX_OBSTACLES, ZERO, Kind, Servoj
from dual_ur10.sim2real.cell_file.text import Key, toml_text, toml_value
from ur_core.files import check_target
from ur_core.kinematics.robots import MODEL_OF_FAMILY, ROBOTS
from ur_core.kinematics.ur10 import ARMS

EXAMPLES: Final = """\
# More that a cell file may hold: take the "# " away from what you need. All keys: docs, reference, cell file.
#
# [left.calibration]  # as on the controller; a key that is missing is that of the nominal model
# a_m = [0.0, -0.612, -0.5723, 0.0, 0.0, 0.0]
# theta_rad = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
#
# [[tracker]]  # source of an object's pose
# prop = "block"
# kind = "attached"
# arm = "left"
# position_m = [0.0, 0.0, 0.17]
#
# [[camera]]  # source of a camera's images
# name = "front"
# kind = "v4l2"
# device = "/dev/video0"
#
# [[obstacle]]
# name = "wall"
# kind = "plane"
# point_m = [1.0, 0.0, 0.0]
# normal = [-1.0, 0.0, 0.0]
#
# [[obstacle]]
# name = "cabinet"
# kind = "box"
# position_m = [0.0, 1.6, 0.4]
# size_m = [0.6, 0.4, 0.8]
#
# [[obstacle]]
# name = "post"
# kind = "capsule"
# from_m = [0.9, -1.2, 0.0]
# to_m = [0.9, -1.2, 1.5]
# radius_m = 0.05
"""


_HEAD: Final = """\
# Cell file

`ARM` is `left` or `right`; both tables have to be there. A word in brackets is the `kind` that a key
belongs to. The file of a real cell has to name what is needed "if real". Units are part of the names. Unknown keys are
refused.

"""


def starting_text(
    kind: Kind = "real",
    left: str | None = None,
    right: str | None = None,
    family: str = "cb3",
    task: str | None = None,
    source: str = "the cell file",
    model: str | None = None,
) -> str:
    """Return a commented file to begin with: slow, and with all keys that the file of such a cell needs.

    Args:
        kind: "real" or "emulated".
        left: Address of the left controller; an emulated cell has one by default.
        right: Address of the right controller, likewise.
        family: Controller family of both.
        task: Id of the environment that it is set up for; None: any.
        source: The file, for messages.
        model: Model of both arms; None: that of `ArmEntry`.

    Raises:
        CellFileError: A value is not legal, or the address of a real arm is missing.
    """
    real, robot = kind == "real", model or MODEL_OF_FAMILY.get(family, "ur10")
    hosts = [left, right] if real else [left or "127.0.0.2", right or "127.0.0.3"]
    for arm, host in zip(ARMS, hosts, strict=True):
        if host is None:
            raise CellFileError(
                f"the address of the {arm} arm is missing: it is on the controller's screen, under network. Give "
                f"it as --{arm}, or write the file of an emulated cell with --kind emulated"
            )
    mounts = [default_mount(arm, robot if robot in ROBOTS else "ur10") for arm in range(len(ARMS))]
    on_controller = {"tcp_position_m": ZERO, "tcp_rotation_rad": ZERO, "payload_kg": 0.0, "payload_cog_m": ZERO}
    arms = {
        arm: {
            "host": host,
            "family": family,
            "model": robot,
            "base_position_m": mount.position_m,
            "base_yaw_rad": mount.yaw_rad,
            **({"base_uncertainty_m": 0.005, "base_uncertainty_rad": 0.01, **on_controller} if real else {}),
            "gripper": {"kind": "none"},
            "servoj": Servoj().mapping(),
            "limits": {"speed_rad_s": FIRST_SPEED_RAD_S, "tcp_speed_m_s": FIRST_TCP_SPEED_M_S},
        }
        for arm, host, mount in zip(ARMS, hosts, mounts, strict=True)
    }
    values: dict[str, Any] = {"kind": kind, "name": "cell"}
    values |= {} if task is None else {"task": task}
    values |= {
        "speed_factor": FIRST_SPEED_FACTOR,
        **({"commissioned": False} if real else {}),
        "rt_priority": 0,
        **arms,
    }
    begin = "# A cell of two arms. To check it: python -m dual_ur10 cell check FILE"
    text = f"{begin}\n\n{toml_text(values, _comment)}\n{EXAMPLES}"
    _, findings = examine_text(text, source)
    if findings:
        raise CellFileError(f"{source}: {findings[0]}")
    return text


def _comment(path: str) -> str | None:
    """Return the comment of a key of the left arm or the cell, or of an arm's table."""
    if path in ARMS:
        return "The left arm." if path == ARMS[0] else "The right arm; its keys mean the same."
    found = {each.path.replace("ARM.", f"{ARMS[0]}."): each for each in keys().keys}.get(path)
    return None if found is None else f"{found.schema['description']}: {found.allowed}"


def reference_page() -> str:
    """Return the page `reference/cell-file.md` of the site: every key with its meaning, legal values and default."""
    rows = "\n".join(map(_row, keys().keys))
    limits = (
        f"A file has at most {MAX_BYTES:,} bytes, {MAX_OBSTACLES} obstacles, and {MAX_DOTS} dots in a line. "
        "How to write and check one, and what has to fit together, is in [the guide](../how-to/cell-file.md).\n"
    )
    return f"{_HEAD}| key | meaning | allowed | needed | default |\n|---|---|---|---|---|\n{rows}\n\n{limits}"


def _row(each: Key) -> str:
    default = each.schema.get("default")
    needed = "yes" if each.required else "if real" if each.schema.get("if_real") else "no"
    name = f"`{each.path}`" + (f" ({each.variant})" if each.variant else "")
    written = "—" if default is None else f"`{toml_value(default)}`"
    return f"| {name} | {each.schema['description']} | {each.allowed} | {needed} | {written} |"


def write_new(path: str | Path, text: str) -> None:
    """Write a file where there is none yet.

    Raises:
        CellFileError: A file of this name exists.
        DualUR10Error: It cannot be written.
    """
    target = Path(path)
    check_target(target)
    try:
        file = target.open("x", encoding="utf-8", newline="")
    except FileExistsError:
        raise CellFileError(
            f"{path} exists: it was left as it is. Name another file, or move that one away first"
        ) from None
    except OSError as error:
        raise DualUR10Error(f"cannot write {path}: {error}") from error
    try:
        with file:
            file.write(text)
    except OSError as error:
        with contextlib.suppress(OSError):
            target.unlink()
        raise DualUR10Error(f"cannot write {path}: {error}") from error
