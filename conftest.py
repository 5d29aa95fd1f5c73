"""Conditions of all tests of this repository."""

pytest_plugins = ["tests.conditions"]
