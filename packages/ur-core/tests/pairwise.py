"""Parameters of tests of which pairs of values matter, and not every combination."""

import itertools

import pytest


def pairwise(**axes):
    """Parametrise a test such that every value of each axis meets every value of each other one, in few rows.

    An axis of several arguments has their names in its own, separated by two underscores, and tuples for values.
    """
    columns = list(itertools.combinations(range(len(axes)), 2))
    numbers = list(itertools.product(*(range(len(values)) for values in axes.values())))
    missing = {(a, b, row[a], row[b]) for row in numbers for a, b in columns}
    names, rows = [name.split("__") for name in axes], []
    while missing:
        best = max(numbers, key=lambda row: sum((a, b, row[a], row[b]) in missing for a, b in columns))
        missing -= {(a, b, best[a], best[b]) for a, b in columns}
        picked = [values[number] for values, number in zip(axes.values(), best, strict=True)]
        rows.append(
            [each for name, value in zip(names, picked, strict=True) for each in (value if name[1:] else [value])]
        )
    return pytest.mark.parametrize([each for name in names for each in name], rows)
