"""Messages: arrays come back to the bit, and nothing but numbers comes in."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from dual_ur10.errors import PolicyServerError
from dual_ur10.policies.remote import wire
from dual_ur10.policies.remote.wire import DTYPES, packed, unpacked

numbers = st.sampled_from(sorted(DTYPES)).flatmap(
    lambda dtype: arrays.arrays(dtype, arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4))
)
content = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**40), 2**40) | st.floats(allow_nan=False) | st.text() | numbers,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=4,
)


def same(one, other):
    if isinstance(other, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    if isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in other)
    return type(one) is type(other) and one == other


@given(value=content)
def test_what_is_sent_is_received(value):
    assert same(unpacked(packed(value), "x"), value)


@given(value=content)
def test_values_are_counted_as_they_are_read(value):
    def count(each):
        if isinstance(each, dict):
            return 1 + sum(count(one) + count(other) for one, other in each.items())
        return 1 + sum(map(count, each)) if isinstance(each, list) else 1

    message = packed(value)
    values = count(msgspec.msgpack.decode(message))
    with pytest.MonkeyPatch.context() as patch:
        for most in (values, values - 1):
            patch.setattr(wire, "MOST_VALUES", most)
            assert wire._has_many_values(message) == (most < values)


@pytest.mark.parametrize(
    "message", [b"\xdd\x00\x10\x00\x00" + bytes(2**20), b"\xdd\xff\xff\xff\xff", b"\xdf\x00\x02\x00\x01"]
)
def test_messages_of_many_values_are_refused_before_they_are_read(message, monkeypatch):
    monkeypatch.setattr(msgspec.msgpack, "decode", lambda _: pytest.fail("it was read"))
    with pytest.raises(PolicyServerError, match="more than 262144 values: send numbers as arrays"):
        unpacked(message, "x")


ARRAY = {b"__ndarray__": True, b"data": bytes(8), b"dtype": "<f4", b"shape": [2]}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({b"dtype": "|O"}, r"array of '\|O'"),
        ({b"dtype": "|V8"}, "array of"),
        ({b"dtype": "<c8"}, "array of"),
        ({b"dtype": 7}, "array of 7"),
        ({b"dtype": None}, "array of None"),
        ({b"shape": [3]}, "but 8 bytes"),
        ({b"shape": [-2]}, "shape"),
        ({b"shape": [True, 2]}, "shape"),
        ({b"shape": "2"}, "shape"),
        ({b"shape": [1, 1, 1, 1, 1, 2]}, "at most 5 axes"),
        ({b"shape": [2**40, 2**40]}, "but 8 bytes"),
        ({b"shape": [0, 2**62], b"data": b""}, "too big"),
        ({b"shape": [0, 2**64 - 1], b"data": b""}, "dimension"),
        ({b"data": "text"}, "but str bytes"),
        ({b"data": None}, "but NoneType bytes"),
    ],
)
def test_arrays_of_another_type_or_shape_are_refused(change, text):
    with pytest.raises(PolicyServerError, match=text):
        unpacked(msgspec.msgpack.encode({"actions": {**ARRAY, **change}}), "x")


def test_numbers_of_numpy_are_read_and_other_objects_are_not():
    number = {b"__npgeneric__": True, b"data": 2.5, b"dtype": "<f8"}
    assert unpacked(msgspec.msgpack.encode({"a": number}), "x") == {"a": 2.5}
    with pytest.raises(PolicyServerError, match="a number that is str"):
        unpacked(msgspec.msgpack.encode({"a": {**number, b"data": "1"}}), "x")
    deep = []
    for _ in range(20):
        deep = [deep]
    for message in (msgspec.msgpack.encode(deep), b"\x91" * 5000 + b"\x01"):
        with pytest.raises(PolicyServerError):
            unpacked(message, "x")
    for value in (object(), np.array(["a"]), np.array([None]), deep):
        with pytest.raises(PolicyServerError, match="cannot be sent"):
            packed(value)
