"""Independence of rows: whatever the number of rows, and however an array lies in memory, a row's bits are the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_ur10.envs.tasks import geometry
from dual_ur10.sim2real.cell.cell_config import CellConfig
from ur_core.kinematics import frames, poses, rotations
from ur_core.kinematics.poses import Poses

_CELL = CellConfig()
_FRAMES = frames.Frames((_CELL.left, _CELL.right))
# Functions of arrays with leading batch axes, with the sizes of a row of each argument: 34 is a pose, 12 a frame.
_FUNCTIONS: dict[str, tuple[Any, tuple[tuple[int, ...] | str, ...]]] = {
    "quat_multiply": (rotations.quat_multiply, ((4,), (4,))),
    "quat_between": (rotations.quat_between, ((4,), (4,))),
    "quat_to_matrix": (rotations.quat_to_matrix, ((4,),)),
    "quat_from_matrix": (rotations.quat_from_matrix, ("matrix",)),
    "quat_from_rotvec": (rotations.quat_from_rotvec, ((3,),)),
    "quat_to_rotvec": (rotations.quat_to_rotvec, ((4,),)),
    "rotate": (rotations.rotate, ((4,), (3,))),
    "cross": (rotations.cross, ((3,), (3,))),
    "compose": (poses.compose, ("pose", "pose")),
    "relative_to": (poses.relative_to, ("pose", "pose")),
    "rotation_angle": (poses.rotation_angle, ((4,),)),
    "length": (poses.length, ((3,),)),
    "geometry.length": (geometry.length, ((3,),)),
    "yaw_quat": (poses.yaw_quat, ((),)),
    "lying": (lambda where: geometry.lying(where, 0.1), ((3,),)),
    "frame_of": (geometry.frame_of, ("pose",)),
    "flanges_of": (lambda tool: geometry.flanges_of(tool, np.array([0.0, 0.01, 0.2])), ("pose",)),
    "to_base_link": (frames.to_base_link, ((3,), "matrix")),
    "quat_to_base_link": (frames.quat_to_base_link, ((4,),)),
    "position_to_base": (_FRAMES.position_to_base, ((2, 3),)),
    "position_to_cell": (_FRAMES.position_to_cell, ((2, 3),)),
    "vector_to_cell": (_FRAMES.vector_to_cell, ((2, 3),)),
    "quat_to_base": (_FRAMES.quat_to_base, ((2, 4),)),
    "quat_to_cell": (_FRAMES.quat_to_cell, ((2, 4),)),
}


def sampled(kind: tuple[int, ...] | str, n: int, rng: np.random.Generator, transposed: bool) -> Any:
    if kind == "pose":
        return Poses(sampled((3,), n, rng, transposed), sampled((4,), n, rng, transposed))
    if kind == "matrix":
        values = rotations.quat_to_matrix(sampled((4,), n, rng, False))
    else:
        values = rng.normal(size=(n, *kind))
        if kind[-1:] == (4,):
            values /= np.linalg.norm(values, axis=-1, keepdims=True)
    return np.asfortranarray(values) if transposed else values


def part(value: Any, rows: slice) -> Any:
    return Poses(*[each[rows] for each in value]) if isinstance(value, Poses) else value[rows]


@pytest.mark.parametrize("name", _FUNCTIONS)
@settings(max_examples=30)
@given(n=st.integers(2, 40), first=st.integers(0, 38), seed=st.integers(0, 2**32 - 1), transposed=st.booleans())
def test_a_row_does_not_depend_on_the_others(name, n, first, seed, transposed):
    function, kinds = _FUNCTIONS[name]
    arguments = [sampled(kind, n, np.random.default_rng(seed + k), transposed) for k, kind in enumerate(kinds)]
    rows = slice(min(first, n - 1), min(first, n - 1) + 1)
    together, alone = function(*arguments), function(*[part(each, rows) for each in arguments])
    for one, other in zip(*(each if isinstance(each, tuple) else (each,) for each in (together, alone)), strict=True):
        assert one[rows].tobytes() == other.tobytes()


@pytest.mark.parametrize("name", _FUNCTIONS)
def test_no_rows_give_no_rows(name):
    function, kinds = _FUNCTIONS[name]
    found = function(*[sampled(kind, 0, np.random.default_rng(0), False) for kind in kinds])
    assert all(len(each) == 0 for each in (found if isinstance(found, tuple) else (found,)))
