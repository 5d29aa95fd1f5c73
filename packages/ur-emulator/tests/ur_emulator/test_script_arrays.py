"""Arithmetic of lists and matrices in programs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import scaled
from tests.ur_emulator.test_script_machine import Robot
from ur_core.errors import ScriptRuntimeError
from ur_emulator.script.operations import put_cell

NUMBERS = st.floats(-1e3, 1e3).map(lambda value: round(value, 3))
OPERATORS = {"+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide, "%": np.mod}


def evaluate(expression):
    return Robot().run(f"say({expression})")[0]


@settings(max_examples=scaled(25))
@given(st.sampled_from("+-*/%"), st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=8))
def test_lists_of_one_length_are_combined_by_element(word, pairs):
    left, right = (list(each) for each in zip(*pairs, strict=True))
    right = [each or 1.0 for each in right]
    np.testing.assert_allclose(evaluate(f"{left} {word} {right}"), OPERATORS[word](left, right), rtol=1e-12)


@settings(max_examples=scaled(25))
@given(st.sampled_from("+-*/%"), st.lists(NUMBERS, min_size=4, max_size=4), NUMBERS)
def test_a_number_is_combined_with_each_element(word, values, factor):
    factor, values = factor or 1.0, [each or 1.0 for each in values]
    matrix = [values[:2], values[2:]]
    for value in (values, matrix):
        np.testing.assert_allclose(evaluate(f"{value} {word} {factor}"), OPERATORS[word](value, factor), rtol=1e-12)
        np.testing.assert_allclose(evaluate(f"({factor}) {word} {value}"), OPERATORS[word](factor, value), rtol=1e-12)


@settings(max_examples=scaled(25))
@given(st.integers(1, 4), st.integers(1, 4), st.integers(1, 4), st.data())
def test_a_matrix_times_a_matrix_or_a_list(rows, inner, columns, data):
    left, right = (
        data.draw(st.lists(st.lists(st.integers(-9, 9), min_size=n, max_size=n), min_size=m, max_size=m))
        for m, n in ((rows, inner), (inner, columns))
    )
    assert evaluate(f"{left} * {right}") == (np.array(left) @ np.array(right)).tolist()
    column = [row[0] for row in right]
    assert evaluate(f"{left} * {column}") == (np.array(left) @ np.array(column)).tolist()


def test_the_integers_of_a_product_have_32_bits():
    assert evaluate(f"[[{2**30}, {2**30 - 1}], [1, 1.0]] * [1, 1]") == [2**31 - 1, 2.0]
    with pytest.raises(ScriptRuntimeError, match="at most 32 bits"):
        evaluate(f"[[{2**30}, {2**30}], [1, 1]] * [1, 1]")


def test_an_assigned_number_leaves_the_other_rows_unread(monkeypatch):
    """A program that fills a matrix does so for each of its elements."""
    matrix = [[1, 2], [3, 4]]
    with pytest.raises(TypeError, match="no lists"):
        put_cell([1], matrix, 1, 0)
    monkeypatch.setattr("ur_emulator.script.operations._matrix", None)
    assert put_cell(1.5, matrix, 1, 0) == [[1, 2], [1.5, 4]]
    assert matrix == [[1, 2], [3, 4]]


def test_operands_are_not_changed():
    assert Robot().run("a = [1, 2]\nb = a * 2\nc = a + b\nsay(a)\nsay(b)\nsay(c)") == [[1, 2], [2, 4], [3, 6]]


def test_long_lists_count_as_several_statements():
    text = f"a = {[1] * 400}\nb = 0\nwhile b < 3:\n  b = b + 1\n  a = a + a\nend"
    Robot().run(text, steps=250)
    with pytest.raises(ScriptRuntimeError, match="infinite loop"):
        Robot().run(text, steps=150)
