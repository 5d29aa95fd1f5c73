"""Viewpoints of a live page."""

from __future__ import annotations

from typing import Any, Final

from ur_core.mjcf.camera import Camera

CAMERA: Final = (2.3, -2.2, 1.8), (-0.1, 0.25, 0.25)
"""Position of the viewpoint and the point that it looks at, m in the cell frame."""

NARROW_CAMERA: Final = (3.6, -3.3, 2.4), (-0.1, 0.0, -0.6)
"""The same where the panel covers the lower part of the picture."""

NARROW: Final = 0.8
"""Ratio of width to height below which it does."""

FOV_RAD: Final = 0.8
"""Vertical angle of the picture."""

START: Final = "start"
"""Name of the viewpoint of a page that was just opened."""


def look_from(client: Any, camera: Camera | None) -> None:
    """Move the viewpoint of one page to that of a camera; None: to where it began."""
    start = NARROW_CAMERA if client.camera.aspect < NARROW else CAMERA
    position, at = start if camera is None else (camera.position_m, camera.target_m)
    with client.atomic():
        # Moving the position moves the point that is looked at, too.
        client.camera.position = position
        client.camera.look_at = at
