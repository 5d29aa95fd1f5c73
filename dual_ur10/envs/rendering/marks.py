"""Marks in a picture of a cell: references, traces, the names of both arms, and the stage in words."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from ur_core.types import Array

ARM_RGB: Final = ((0, 114, 178), (213, 94, 0))
"""Colours of the left and the right arm, of Okabe and Ito's, which colour-blind readers can tell apart."""

_OBJECT_RGB: Final = (0, 158, 115)
_REFERENCE_RGB: Final = (255, 255, 255)
_TRACE_S: Final = 1.5  # time that a trace shows

_TRACED: Final = {"flange_m": ARM_RGB, "object_m": (_OBJECT_RGB,)}
"""Traced values of `info` with the colours of their rows; flanges only where they have references."""

_REFERENCES: Final = {"reference_m": ARM_RGB, "object_reference_m": (_OBJECT_RGB,)}
"""References in `info`, in the cell frame, with the colours of their rows."""


class Marks:
    """References as balls, and the last path of them and of what follows them as traces.

    A task shows its own by the values `reference_m`, (2, 3), of both flanges, and `object_m` and `object_reference_m`,
    (3,), of its object in `info`, in the cell frame.

    Args:
        infos: `info` of an episode, of one instant after another.
        period_s: Time between two of them.
    """

    def __init__(self, infos: Sequence[Mapping[str, Any]], period_s: float) -> None:
        self._time_s: Array = period_s * np.arange(len(infos), dtype=np.float64)
        shown = {**_REFERENCES, **_TRACED}
        if "reference_m" not in infos[-1]:
            del shown["flange_m"]
        self._paths = {
            name: np.array([np.reshape(each[name], (-1, 3)) for each in infos], dtype=np.float64)
            for name in shown
            if all(name in each for each in infos)
        }

    def at(self, time_s: float) -> _Moment:
        """Return the marks of one instant, for `Canvas.image`."""
        return _Moment(self._paths, self._time_s, time_s)


class _Moment:
    def __init__(self, paths: Mapping[str, Array], times_s: Array, now_s: float) -> None:
        self._points: dict[str, Array] = {}
        for name, path in paths.items():
            recent = (times_s > now_s - _TRACE_S) & (times_s < now_s)
            last = min(int(np.searchsorted(times_s, now_s)), len(times_s) - 1)
            before = max(last - 1, 0)
            span = times_s[last] - times_s[before]
            ratio = (now_s - times_s[before]) / span if span > 0.0 else 0.0
            here = path[before] + min(max(ratio, 0.0), 1.0) * (path[last] - path[before])
            self._points[name] = np.concatenate([path[recent], here[None]])

    def __call__(self, scene: Any) -> None:
        """Add the marks to MuJoCo's scene."""
        for name, colors in _REFERENCES.items():
            for row, rgb in enumerate(colors if name in self._points else ()):
                path = self._points[name][:, row]
                _trace(scene, path, _REFERENCE_RGB, 0.008, 0.6)
                _ball(scene, path[-1], rgb, 0.03, 0.6)
        for name, colors in _TRACED.items():
            for row, rgb in enumerate(colors if name in self._points else ()):
                _trace(scene, self._points[name][:, row], rgb, 0.006, 0.9)


def _ball(scene: Any, at: Array, rgb: tuple[int, int, int], radius_m: float, opacity: float) -> None:
    import mujoco

    geom = _next(scene)
    if geom is not None:
        size, color = np.full(3, radius_m), np.array([*np.divide(rgb, 255), opacity], np.float32)
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_SPHERE, size, at, np.eye(3).ravel(), color)


def _trace(scene: Any, path: Array, rgb: tuple[int, int, int], radius_m: float, opacity: float) -> None:
    """Add a path that fades towards its beginning."""
    import mujoco

    for number, (begin, end) in enumerate(itertools.pairwise(path)):
        if np.linalg.norm(end - begin) < 1e-4:
            continue
        geom = _next(scene)
        if geom is None:
            return
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        color = np.array([*np.divide(rgb, 255), opacity * (number + 1) / len(path)], np.float32)
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), color)
        mujoco.mjv_connector(geom, kind, radius_m, begin, end)


def _next(scene: Any) -> Any:
    """Return the next free geom of a scene; None if it is full."""
    if scene.ngeom >= scene.maxgeom:
        return None
    scene.ngeom += 1
    return scene.geoms[scene.ngeom - 1]


def describe(stages: Sequence[str], info: Mapping[str, Any]) -> str:
    """Return the stage of a task, or its error, in a few words; "" for a task that has neither.

    Args:
        stages: Names of the task's stages.
        info: That of a reset or step.
    """
    count = len(stages)
    if "stage" in info and count:
        passed = int(info["stage"])
        return f"stage {passed + 1} of {count}: {stages[passed].replace('_', ' ')}" if passed < count else "all passed"
    if "flange_error_m" in info:
        left, right = 1e3 * np.asarray(info["flange_error_m"])
        return f"error L {left:.2f} mm, R {right:.2f} mm"
    if "object_error_m" in info:
        return f"object off by {1e3 * float(info['object_error_m']):.1f} mm"
    return ""
