"""Comparison of observations and infos in every bit."""

import numpy as np


def equal(one, other):
    """Return True if two arrays, or nested dicts of arrays, are equal."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[name], other[name]) for name in one)
    return np.array_equal(one, other)
