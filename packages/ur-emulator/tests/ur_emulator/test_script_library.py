"""Functions of URScript that need no robot, against scipy and worked examples."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ur_emulator.script import Pose, library, text

F: dict[str, Callable[..., Any]] = library(0.002)

POSES = st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6).map(Pose)


def matrix(pose: list[float]) -> np.ndarray:
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_rotvec(pose[3:]).as_matrix()
    frame[:3, 3] = pose[:3]
    return frame


def same(pose: list[float], frame: np.ndarray) -> None:
    assert type(pose) is Pose
    assert math.hypot(*pose[3:]) <= math.pi + 1e-12
    np.testing.assert_allclose(matrix(pose), frame, atol=1e-12)


@given(POSES, POSES)
def test_poses_against_matrices(first: Pose, second: Pose) -> None:
    a, b = matrix(first), matrix(second)
    same(F["pose_trans"](first, second), a @ b)
    same(F["pose_inv"](first), np.linalg.inv(a))
    added, taken = a @ b, a @ b
    added[:3, 3], taken[:3, 3] = a[:3, 3] + b[:3, 3], a[:3, 3] - b[:3, 3]
    taken[:3, :3] = a[:3, :3] @ b[:3, :3].T
    same(F["pose_add"](first, second), added)
    same(F["pose_sub"](first, second), taken)
    assert F["point_dist"](first, second) == pytest.approx(float(np.linalg.norm(a[:3, 3] - b[:3, 3])))


@given(POSES, POSES)
def test_interpolation_starts_and_ends_at_the_poses(first: Pose, second: Pose) -> None:
    same(F["interpolate_pose"](first, second, 0), matrix(first))
    same(F["interpolate_pose"](first, second, 1.0), matrix(second))


def test_interpolation_is_even() -> None:
    found = F["interpolate_pose"](Pose([0, 0, 0, 0, 0, 1]), Pose([4, 0, 0, 0, 0, 2]), 0.25)
    np.testing.assert_allclose(found, [1, 0, 0, 0, 0, 1.25], atol=1e-15)


@given(st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3))
def test_roll_pitch_yaw(rpy: list[float]) -> None:
    rotvec = F["rpy2rotvec"](rpy)
    np.testing.assert_allclose(
        Rotation.from_rotvec(rotvec).as_matrix(), Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(F["rotvec2rpy"](rotvec), rpy, atol=1e-9)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
@pytest.mark.parametrize("roll", [0.0, 0.4])
def test_roll_pitch_yaw_at_90_degrees(pitch: float, roll: float) -> None:
    rotvec = F["rpy2rotvec"]([roll, pitch, 0.3])
    again = F["rpy2rotvec"](F["rotvec2rpy"](rotvec))
    np.testing.assert_allclose(
        Rotation.from_rotvec(again).as_matrix(), Rotation.from_rotvec(rotvec).as_matrix(), atol=1e-6
    )


@pytest.mark.parametrize(
    ("name", "arguments", "expected"),
    [
        ("sin", (1,), math.sin(1)),
        ("cos", (1,), math.cos(1)),
        ("tan", (1,), math.tan(1)),
        ("asin", (0.3,), math.asin(0.3)),
        ("acos", (0.3,), math.acos(0.3)),
        ("atan", (0.3,), math.atan(0.3)),
        ("atan2", (1, -2), math.atan2(1, -2)),
        ("sqrt", (9,), 3.0),
        ("pow", (2, 3), 8.0),
        ("log", (2, 8), 3.0),
        ("ceil", (1.2,), 2),
        ("floor", (-1.2,), -2),
        ("d2r", (180,), math.pi),
        ("r2d", (math.pi,), 180.0),
        ("norm", (-3,), 3),
        ("norm", ([3, 4],), 5.0),
        ("length", ([1, 2],), 2),
        ("length", ("abc",), 3),
        ("get_list_length", ([],), 0),
        ("binary_list_to_integer", ([True, False, True],), 5),
        ("binary_list_to_integer", ([True] * 32,), -1),
        ("integer_to_binary_list", (5,), [True, False, True] + [False] * 29),
        ("integer_to_binary_list", (-1,), [True] * 32),
        ("str_at", ("abc", 1), "b"),
        ("str_cat", ("ab", "c"), "abc"),
        ("str_empty", ("",), True),
        ("str_empty", ("a",), False),
        ("str_find", ("abcabc", "c"), 2),
        ("str_find", ("abcabc", "c", 3), 5),
        ("str_find", ("abc", "x"), -1),
        ("str_len", ("abc",), 3),
        ("str_sub", ("abcdef", 2, 3), "cde"),
        ("str_sub", ("abcdef", 2), "cdef"),
        ("str_sub", ("abcdef", 2, 0), ""),
        ("str_sub", ("abcdef", 6, 50), ""),
        ("to_num", ("12",), 12),
        ("to_num", (" -12.5e1",), -125.0),
        ("to_num", ("+5.",), 5.0),
        ("to_num", (".36",), 0.36),
        ("to_num", ("0X3A",), 58),
        ("to_num", ("-0xb5",), -181),
        ("to_num", ("-2147483648",), -(2**31)),
        ("to_num", ("-Infinity",), -math.inf),
        ("to_str", ([1, 2.5, True],), "[1, 2.5, True]"),
        ("to_str", (Pose([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),), "p[1, 2, 3, 4, 5, 6]"),
        ("to_str", (2.123456123456,), "2.123456"),
        ("to_str", ([10.0, -0.25, 1e-7, 1e20, math.inf],), "[10, -0.25, 0, 100000000000000000000, inf]"),
        ("str_cat", ("x = ", 1.50), "x = 1.5"),
        ("to_str", ("a",), "a"),
    ],
)
def test_values(name: str, arguments: tuple[Any, ...], expected: Any) -> None:
    found = F[name](*arguments)
    assert found == (pytest.approx(expected) if isinstance(expected, float) else expected)
    assert type(found) is type(expected)


@pytest.mark.parametrize(
    ("name", "arguments", "error"),
    [
        ("sin", ("a",), TypeError),
        ("ceil", (1e300,), OverflowError),
        ("to_num", ("x",), ValueError),
        ("to_num", ("9999999999",), OverflowError),
        ("to_num", (5000 * "9",), OverflowError),
        ("to_num", ("0x80000000",), OverflowError),
        ("to_num", ("1e999",), OverflowError),
        *(("to_num", (text,), ValueError) for text in ("1_000", "123abc", "1 ", "", "0x", "1e", "\u0663", "--1")),
        ("str_at", ("a", 1), IndexError),
        ("str_at", ("a", -1), IndexError),
        ("str_sub", ("a", -1, 1), IndexError),
        ("str_sub", ("a", 2), IndexError),
        ("str_sub", ("a", 0, -1), IndexError),
        ("str_find", ("a", "a", -1), IndexError),
        ("str_len", (1,), TypeError),
        ("get_list_length", ("abc",), TypeError),
        ("length", (1,), TypeError),
        ("binary_list_to_integer", ([True] * 33,), ValueError),
        ("pose_trans", ([1, 2], Pose([0] * 6)), TypeError),
        ("pose_trans", (Pose([0] * 6), 1), TypeError),
        ("rpy2rotvec", ([1, 2],), TypeError),
        ("str_cat", ("a" * 1000, "b" * 24), ValueError),
        ("to_str", ([1.5] * 1000,), ValueError),
    ],
)
def test_wrong_arguments(name: str, arguments: tuple[Any, ...], error: type[Exception]) -> None:
    with pytest.raises(error):
        F[name](*arguments)


def test_random_numbers() -> None:
    found = [F["random"]() for _ in range(100)]
    assert 0 <= min(found) < max(found) <= 1


def test_poses_have_six_numbers() -> None:
    with pytest.raises(ValueError, match="6 numbers, found 5"):
        Pose([1] * 5)
    with pytest.raises(TypeError, match="found a string"):
        Pose([0, 0, 0, 0, 0, "a"])  # type: ignore[list-item]
    assert text(Pose([1, 0, 0, 0, 0, 0])) == "p[1, 0, 0, 0, 0, 0]"
