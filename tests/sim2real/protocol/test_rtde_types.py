import math
import struct

import numpy as np
import pytest

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.protocol.rtde_types import TYPES


def test_sizes_are_those_of_the_rtde_guide():
    sizes = {name: struct.calcsize(f">{kind.count}{kind.code}") for name, kind in TYPES.items()}
    assert sizes == {
        "BOOL": 1,
        "UINT8": 1,
        "UINT32": 4,
        "UINT64": 8,
        "INT32": 4,
        "DOUBLE": 8,
        "VECTOR3D": 24,
        "VECTOR6D": 48,
        "VECTOR6INT32": 24,
        "VECTOR6UINT32": 24,
    }


def test_zeros_have_the_types_python_would_use():
    assert TYPES["DOUBLE"].zero == 0.0
    assert isinstance(TYPES["DOUBLE"].zero, float)
    assert isinstance(TYPES["INT32"].zero, int)
    assert TYPES["BOOL"].zero is False
    assert TYPES["VECTOR3D"].zero == (0.0, 0.0, 0.0)
    assert TYPES["VECTOR6INT32"].zero == (0,) * 6


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        ("UINT8", 256 + 7, 7),
        ("UINT8", -1, 255),
        ("UINT32", 1 << 40 | 5, 5),
        ("UINT64", -1, (1 << 64) - 1),
        ("INT32", 1 << 31, -(1 << 31)),
        ("INT32", -(1 << 31) - 1, (1 << 31) - 1),
        ("INT32", 2.9, 2),
        ("INT32", math.nan, 0),
        ("UINT32", -math.inf, 0),
        ("INT32", np.int64(-3), -3),
        ("DOUBLE", 10**400, math.inf),
        ("DOUBLE", -(10**400), -math.inf),
        ("DOUBLE", math.inf, math.inf),
        ("BOOL", 7, True),
    ],
)
def test_numbers_are_made_to_fit(kind, value, expected):
    assert TYPES[kind].fit("x", value) == [expected]
    struct.pack(">" + TYPES[kind].code, *TYPES[kind].fit("x", value))


def test_nan_passes_in_doubles():
    assert math.isnan(TYPES["VECTOR3D"].fit("x", (0.0, math.nan, 1.0))[1])


@pytest.mark.parametrize(
    ("kind", "value"), [("VECTOR6D", (1.0,) * 5), ("VECTOR6D", 1.0), ("DOUBLE", "?"), ("INT32", None)]
)
def test_what_is_no_value_of_the_type_is_refused_by_name(kind, value):
    with pytest.raises(SettingsError, match="actual_q"):
        TYPES[kind].fit("actual_q", value)
