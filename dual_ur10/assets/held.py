"""What a gripper holds, in the twin that measures distances: as if it held its share of the prop all the time.

Nothing tells the safety gate what is between the fingers, or whether anything is. So each hand of a cell with a prop
has that prop where it should grip it: of the bar, which both hold, up to its middle. An empty hand keeps the same
distances. But for the table, on which the prop lies: there a hand that comes to take it, and is not level, would be
refused for what it does not hold yet.
"""

from __future__ import annotations

from typing import Any, Final

from dual_ur10.assets.gripper import TCP_M
from dual_ur10.assets.props import BAR_LENGTH_M, BAR_WIDTH_M, BLOCK_GRIP_M, BLOCK_SIZE_M, GRIP_DISTANCE_M
from dual_ur10.kinematics.ur10 import ARMS, LINKS

HELD: Final = "held"
"""Name of the geom of each arm: a capsule in the prop, of its width. Its edges stand out by 8 mm."""

# What it can meet: the other arm but for its fingers, which take it, and those parts of its own that can get there.
_OTHERS: Final = ("base_link", *LINKS, "palm")
_OWN: Final = ("base_link", "shoulder_link", "upper_arm_link", "forearm_link")

PAIRS: Final = tuple(
    pair
    for arm, other in (ARMS, ARMS[::-1])
    for pair in (
        *((f"{arm}/{HELD}", f"{other}/{part}") for part in _OTHERS),
        *((f"{arm}/{HELD}", f"{arm}/{part}") for part in _OWN),
        (f"{arm}/{HELD}", "floor"),
    )
)
"""Pairs of the twin that what is held adds."""


def add_held(gripper: Any, arm: str, prop: str) -> None:
    """Put what a hand holds into its gripper's body, without a mass: the body's is given.

    Args:
        gripper: Body of a gripper in dm_control's tree.
        arm: "left" or "right".
        prop: Name of the prop.
    """
    first, last = _along_m(prop)
    side = 1.0 if arm == ARMS[0] else -1.0
    width = BAR_WIDTH_M if prop == "bar" else BLOCK_SIZE_M[1]
    fromto = (side * (first + width / 2), 0, TCP_M, side * (last - width / 2), 0, TCP_M)
    gripper.add("geom", name=HELD, type="capsule", fromto=fromto, size=(width / 2,))


def _along_m(prop: str) -> tuple[float, float]:
    """From where to where it reaches along the left tool's x; along the right tool's it is the other way round."""
    if prop == "bar":
        return -(BAR_LENGTH_M - GRIP_DISTANCE_M) / 2, GRIP_DISTANCE_M / 2
    return -(BLOCK_SIZE_M[0] / 2 + BLOCK_GRIP_M), BLOCK_SIZE_M[0] / 2 - BLOCK_GRIP_M
