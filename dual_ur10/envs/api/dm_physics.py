"""The scene of a dm_env environment as dm_control's viewer and its suite's wrappers look at it.

It has the part of `dm_control.mujoco.Physics` that they use. That class itself does not work with MuJoCo 4.0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.rendering.images import Renderer
from dual_ur10.errors import UnknownNameError


class DmStruct:
    """MuJoCo's model or data, with what dm_control's wrappers of them add.

    Attributes:
        ptr: The model or data itself.
    """

    def __init__(self, ptr: Any) -> None:
        self.ptr = ptr

    def __getattr__(self, name: str) -> Any:
        if name == "ptr":  # not yet set, in a copy
            raise AttributeError(name)
        return getattr(self.ptr, name)

    def id2name(self, index: int, kind: str) -> str:
        """Return the name of an object of a model, such as a "camera"; "" if it has none."""
        return str(getattr(self.ptr, kind)(index).name)


class DmPhysics:
    """Copy of the scene for drawing. Nothing that is written to it, such as a push in the viewer, moves the simulation.

    Attributes:
        model, data: Model and data of the scene, with what is only visual; the same objects for an environment's life.

    Args:
        read: Returns MuJoCo's model and data in their present state, the same objects at every call.
    """

    def __init__(self, read: Callable[[], tuple[Any, Any]]) -> None:
        self._read = read
        model, data = read()
        self.model, self.data = DmStruct(model), DmStruct(data)
        self._renderers: dict[tuple[Any, ...], Renderer] = {}

    def update(self) -> None:
        """Read the present state."""
        self._read()

    def time(self) -> float:
        """Return the simulated time in s."""
        return float(self.data.time)

    def timestep(self) -> float:
        """Return the physics step in s."""
        return float(self.model.opt.timestep)

    def render(self, height: int = 240, width: int = 320, camera_id: int | str = 0) -> NDArray[np.uint8]:
        """Return an image, (height, width, 3).

        Args:
            height: Height in pixels.
            width: Width in pixels.
            camera_id: Number or name of a camera of the scene. There is no free camera, -1.

        Raises:
            UnknownNameError: There is no such camera.
            SettingsError: The size is not possible.
            RenderError: No OpenGL backend was found.
        """
        names = [self.model.id2name(index, "camera") for index in range(self.model.ncam)]
        if isinstance(camera_id, int) and 0 <= camera_id < len(names):
            camera_id = names[camera_id]
        if camera_id not in names:
            raise UnknownNameError("camera", str(camera_id), names)
        key = (height, width, camera_id)
        if key not in self._renderers:
            self._renderers[key] = Renderer(str(camera_id), width, height, cameras=names)
        return self._renderers[key].image(self.model.ptr, self.data.ptr)

    def close(self) -> None:
        """Release OpenGL. May be called twice."""
        for each in self._renderers.values():
            each.close()
        self._renderers.clear()
