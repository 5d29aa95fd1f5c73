"""Drag handles at both tools, in the page that commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dual_ur10.envs.rendering.live.about import About
from dual_ur10.envs.rendering.live.commander import Commander
from dual_ur10.envs.rendering.live.scene import MOVED_M, Poser
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array


class DragHandles:
    """Handles at both tools of the pages that have them.

    Args:
        about: What the page shows.
        commander: The one page that commands.
        poser: Poses of the tools.
    """

    def __init__(self, about: About, commander: Commander, poser: Poser) -> None:
        self._about, self._commander, self._poser = about, commander, poser
        self._handles: dict[int, list[Any]] = {}

    def tool(self, arm: int) -> Array:
        """Return the commanded pose of a tool in the cell frame, (7,)."""
        pose: Array = self._poser.tool_targets()[arm]
        return pose

    def add(self, client: Any) -> None:
        """Add the drag handles to one page alone."""
        if not self._about.handles or client.client_id in self._handles:
            return
        poses = self._poser.tool_targets()
        handles = []
        for arm, name in enumerate(ARMS):
            handle = client.scene.add_transform_controls(
                f"/handles/{name}",
                scale=0.25,
                line_width=4.0,
                depth_test=False,
                disable_sliders=False,
                position=poses[arm, :3],
                wxyz=poses[arm, 3:],
            )
            handle.on_update(self._drag_of(arm))
            handles.append(handle)
        self._handles[client.client_id] = handles

    def remove(self, client: int) -> None:
        """Remove the handles of a page that watches from now on."""
        for handle in self._handles.pop(client, ()):
            handle.remove()

    def forget(self, client: int) -> None:
        """Forget the handles of a page that is closed, which have gone with it."""
        self._handles.pop(client, None)

    def follow(self) -> None:
        """Let the handles that nobody drags follow the commanded tools."""
        poses = self._poser.tool_targets()
        for handles in list(self._handles.values()):
            for arm, handle in enumerate(handles):
                pose, shown = poses[arm], np.concatenate([handle.position, handle.wxyz])
                if not self._commander.dragged(arm) and np.abs(pose - shown).max() > MOVED_M:
                    handle.position, handle.wxyz = pose[:3], pose[3:]

    def _drag_of(self, arm: int) -> Callable[[Any], Any]:
        async def drag(event: Any) -> None:
            pose = np.concatenate([event.target.position, event.target.wxyz])
            self._commander.drag(event.client_id, arm, pose, held=event.phase != "end")

        return drag
