"""Names of URScript's functions: those of the emulator are all in the list, and the page shows each."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from tests.ur_emulator.ticking import Bench
from ur_core.errors import ScriptSyntaxError
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_emulator.builtins.table import builtins_of
from ur_emulator.controller.controller import Controller
from ur_emulator.profile import POLYSCOPES
from ur_emulator.script import parse
from ur_emulator.script.manual import MANUAL, NAMES


def functions_of(profile):
    return Controller("left", profile, np.zeros(6), 1, dh=NOMINAL_DH, builtins=builtins_of).program.builtins


KNOWN = {name for profile in POLYSCOPES.values() for name in functions_of(profile)}


def test_every_function_of_the_emulator_is_in_the_list_once():
    assert KNOWN <= NAMES
    assert sum(map(len, MANUAL.values())) == len(NAMES)


def test_an_unknown_function_is_told_from_one_that_is_not_emulated():
    builtins = Bench().controller.program.builtins
    for name in sorted(NAMES - KNOWN):
        with pytest.raises(ScriptSyntaxError, match="UR's manual is not emulated"):
            parse(f"{name}()", builtins)
    with pytest.raises(ScriptSyntaxError, match="there is no such function"):
        parse("no_such_function()", builtins)


def test_the_page_shows_every_function(monkeypatch):
    pytest.importorskip("mkdocs")
    monkeypatch.syspath_prepend(Path(__file__).parents[4] / "docs")
    known, missing = importlib.import_module("hooks").urscript().split("## Functions that are not emulated")
    for name in KNOWN:
        assert f"| `{name}(" in known
        assert f"`{name}`" not in missing
    for name in NAMES - KNOWN:
        assert f"`{name}`" in missing
        assert f"`{name}(" not in known
