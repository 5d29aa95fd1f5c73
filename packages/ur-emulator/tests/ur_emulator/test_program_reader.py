"""Long programs are read in a process of their own, with the same result."""

import pytest

from tests.ur_emulator.ticking import Bench
from ur_core.errors import ScriptSyntaxError
from ur_core.processes.system import LOCAL
from ur_emulator.controller.program_reader import SHORT, ProgramReader
from ur_emulator.script import Machine, compiled

LONG = ("def p():\n"
        "  thread t(a=[1.5, p[0, 0, 0, 0, 0, 0]]):\n    sleep(0.1)\n  end\n  digital_out[1] = True\n  run t()\n"
        + '  movej([0, -1.57, 1.57, 0, 0, 0], a=1.2)\n  textmsg("ä", to_str(1e3))\n' * 20 + "end\n")  # fmt: skip
FILLER = "\n" * SHORT


@pytest.fixture(scope="module")
def builtins():
    return Bench("e-series").controller.program.builtins


@pytest.fixture(scope="module")
def reader(builtins):
    made = ProgramReader(LOCAL, "left", builtins)
    yield made
    made.close()


def test_no_long_program_is_parsed_in_this_process(reader, builtins, monkeypatch):
    texts = [LONG, LONG.replace("def p", "sec s").replace("movej", "servoj"), "sync()" + FILLER]
    assert min(map(len, texts)) > SHORT
    here = [compiled.compiled(text, builtins) for text in texts]
    monkeypatch.setattr(compiled, "parse_text", None)
    for text, expected in zip(texts, here, strict=True):
        found = reader.submit(text).result(30.0)
        assert (found.name, found.is_secondary, found.lines) == (expected.name, expected.is_secondary, expected.lines)
        assert (found.code, found.used) == (expected.code, expected.used)
        Machine(found, builtins, steps_per_tick=5000)
        assert reader.submit(text).result(30.0) is found  # known


def test_errors_of_long_programs_are_those_of_short_ones(reader, builtins):
    for line in ("x = (", "nobody()", "sync(1)", "optimovej([0, 0, 0, 0, 0, 0])", "get_conveyor_tick_count()"):
        text = f"def p():\n  {line}\nend\n" + FILLER
        found, expected = reader.submit(text).result(30.0), compiled.compiled(text, builtins)
        assert isinstance(found, ScriptSyntaxError)
        assert (type(found), str(found), found.column) == (type(expected), str(expected), expected.column)


def test_a_process_that_ends_refuses_one_program(reader):
    assert reader.submit("a = 1" + FILLER).result(30.0).name == "unnamed"
    reader._process._process.kill()
    assert "could not be read" in str(reader.submit("a = 2" + FILLER).result(30.0))
    assert reader.submit("a = 2" + FILLER).result(30.0).name == "unnamed"


def test_the_process_ends_with_the_reader(builtins):
    reader = ProgramReader(LOCAL, "left", builtins)
    reader.prepare()
    reader.submit("pass").result(30.0)  # after it
    process = reader._process._process
    reader.submit("a = 3" + FILLER).result(30.0)
    assert process is reader._process._process
    assert process.is_alive
    reader.close()
    assert not process.is_alive
    with pytest.raises(RuntimeError, match="after shutdown"):
        reader.submit("a = 4")
