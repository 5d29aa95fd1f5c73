"""Conditions of the tests of this distribution."""

pytest_plugins = ["tests.conditions"]
