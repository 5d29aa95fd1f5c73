"""Agreement of success in simulation with success on a cell."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.errors import SettingsError
from dual_ur10.policies.evaluation.agreement import (
    COLUMNS,
    Agreement,
    MeasuredPolicy,
    SuccessCount,
    agreements,
    read_policies,
)
from tests.cli import command

HEAD = ",".join(COLUMNS)


def one(simulated: list[int], measured: list[int], episodes: int = 10) -> Agreement:
    """Agreement of policies with so many successes."""
    rows = [
        MeasuredPolicy("Task", str(k), SuccessCount(a, episodes), SuccessCount(b, episodes))
        for k, (a, b) in enumerate(zip(simulated, measured, strict=True))
    ]
    return agreements(rows)[0]


def test_figures_are_those_of_worked_examples() -> None:
    found = one([2, 5, 9], [1, 6, 8])
    assert found.pearson == pytest.approx(24 / np.sqrt(74 / 3 * 26), rel=1e-12)
    assert (found.spearman, found.max_rank_violation, found.notes) == (1.0, 0.0, ())
    # Policies 0 and 1 are reversed, 0.3 apart on the cell; 1 - 6 * 2 / (4 * 15).
    found = one([2, 5, 8, 9], [5, 2, 8, 9])
    assert found.spearman == pytest.approx(0.8)
    assert found.max_rank_violation == pytest.approx((0.3 + 0.3 + 0 + 0) / 4)


def test_ties_share_a_rank_and_are_noted() -> None:
    found = one([5, 5, 9], [1, 3, 8])
    assert found.spearman == pytest.approx(np.corrcoef([1.5, 1.5, 3.0], [1, 2, 3])[0, 1])
    assert found.max_rank_violation == pytest.approx(0.2 / 3)  # of the one that exceeds the other on the cell alone
    assert found.notes == ("2 of 3 policies share a rate with another one in simulation: their order is open",)


def test_equal_rates_have_no_correlation() -> None:
    found = one([5, 5, 5], [1, 3, 8])
    assert (found.pearson, found.spearman) == (None, None)
    assert found.notes == ("all policies have the same rate in simulation: there is no correlation",)


@given(st.lists(st.tuples(st.integers(0, 10), st.integers(0, 10)), min_size=3, max_size=12), st.randoms())
def test_figures_depend_on_no_order_and_ranks_on_no_scale(rates: list[tuple[int, int]], random: object) -> None:
    simulated, measured = map(list, zip(*rates, strict=True))
    found = one(simulated, measured)
    random.shuffle(rates)  # type: ignore[attr-defined]
    again = one(*map(list, zip(*rates, strict=True)))
    stretched = one([each**2 for each in simulated], measured, episodes=100)
    for this, other in ((found.pearson, again.pearson), (found.spearman, again.spearman)):
        assert (this is None) == (other is None)
        assert this is None or other == pytest.approx(this, abs=1e-12)
        assert this is None or -1.0 <= this <= 1.0
    assert found.max_rank_violation == pytest.approx(again.max_rank_violation)
    assert found.spearman is None or stretched.spearman == pytest.approx(found.spearman, abs=1e-12)
    best = one(simulated, simulated)
    assert (best.max_rank_violation, best.spearman is None or best.spearman == pytest.approx(1.0)) == (0.0, True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has the columns of no line: a table of policies has task, policy, simulation_successes"),
        ("policy,success\na,1\n", "has the columns policy, success: a table"),
        (f"{HEAD},more\n", "cell_episodes, more: a table"),
        (f"{HEAD}\nA,x,1,2,1,2\nA,y,1,2,1,2\n", "2 policies of A: a correlation needs 3 or more"),
        (f"{HEAD}\n", "the table has no policies"),
        (f"{HEAD}\nA,x,1,2,1\n", "row 2 has 5 values: there are 6 columns"),
        (f"{HEAD}\nA,x,1,2,1,2\n\nA,x,1,2,1,2\n", "row 4 is the second one of 'x' in 'A'"),
        (f"{HEAD}\n,x,1,2,1,2\n", "row 2 names no task"),
        (f"{HEAD}\nA,x,3,2,1,2\n", "3 successes in 2 episodes (simulation)"),
        (f"{HEAD}\nA,x,1,2,0,0\n", "0 successes in 0 episodes (cell)"),
        (f"{HEAD}\nA,x,90 %,2,1,2\n", "simulation_successes is '90 %': it must be a whole number"),
        (f"{HEAD}\nA,x,1,-2,1,2\n", "simulation_episodes is '-2'"),
        (f"{HEAD}\nA,x,1,{'9' * 5000},1,2\n", "it must be a whole number"),
        (f"{HEAD}\nA,x,1,{'0' * 5000}2,1,2\n", "it must be a whole number"),
        (f'{HEAD}\nA,"x,1,2,1,2\n', "must be a CSV file in UTF-8"),
    ],
)
def test_command_names_what_is_wrong_with_a_table(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_text(text)
    code, printed = command.run("compare", str(path))
    assert code == 2
    assert message in printed


def test_bytes_that_are_no_table_are_named(tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SettingsError, match="must be a CSV file in UTF-8"):
        read_policies(path)
    with pytest.raises(SettingsError, match="cannot read"):
        read_policies(tmp_path)


def test_command_prints_and_writes_the_figures_of_each_task(tmp_path: Path) -> None:
    path, out = tmp_path / "p.csv", tmp_path / "x.json"
    names = list(reversed(COLUMNS))  # in any order
    rows = [
        dict(zip(COLUMNS, row, strict=True))
        for row in ([*("A", "good"), 9, 10, 8, 10], [*("A", "fair"), 5, 10, 2, 10], [*("A", "poor"), 0, 10, 0, 10])
    ]
    text = "\r\n".join(",".join(str(row[name]) for name in names) for row in rows)
    path.write_bytes(b"\xef\xbb\xbf" + f"{','.join(names)}\r\n{text}\r\n".encode())  # as spreadsheets write it
    code, printed = command.run("compare", str(path), "--out", str(out))
    assert code == 0
    assert "9 of 10: 60 to 98 %" in printed
    assert "3 policies: Pearson's r 0.941, Spearman's rank correlation 1.000, mean maximum" in printed
    (found,) = json.loads(out.read_text())
    assert (found["task"], found["spearman"]) == ("A", 1.0)
    assert found["policies"][0]["cell"]["rate"] == 0.8
    assert found["policies"][0]["cell"]["interval"] == list(SuccessCount(8, 10).interval)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("runs/A",), "runs/A alone: name two recorded runs, or a table of policies"),
        (("a.csv", "b.csv"), "a table of policies is compared alone"),
        (("a.csv", "--out", "x.html"), "--out is x.html"),
        (("absent.csv",), "cannot read absent.csv"),
    ],
)
def test_command_names_what_does_not_go_together(arguments: tuple[str, ...], message: str) -> None:
    code, printed = command.run("compare", *arguments)
    assert code == 2
    assert message in printed
