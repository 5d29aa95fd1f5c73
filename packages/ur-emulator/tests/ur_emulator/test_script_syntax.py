"""Invalid URScript is refused with line and word, and Python is out of reach."""

from __future__ import annotations

import random
import re

import pytest
from lark import Token

from tests.soak import SOAK
from ur_core.errors import ScriptRuntimeError, ScriptSyntaxError
from ur_emulator.script import Machine, library, parse
from ur_emulator.script.parser import _LARK

BUILTINS = {**library(0.008), "move": lambda q, a=1.4, v=1.05: None}


@pytest.mark.parametrize(
    ("text", "line", "word", "reason"),
    [
        ("def f():\n\n  nothing(1)\nend", 3, "nothing", "no such function"),
        ("x = y", 1, "y", "nothing assigns"),
        ("y[0] = 1", 1, "y", "nothing assigns"),
        ("move([0], speed=1)", 1, "move", "unexpected keyword argument 'speed'"),
        ("move()", 1, "move", "missing a required argument"),
        ("move(1, 2, 3, 4)", 1, "move", "too many"),
        ("move(a=1, a=2)", 1, "a", "twice"),
        ("def f():\n" + "".join(f"def g{k}():\nend\n" for k in range(1001)) + "end", 2002, "g1000", "at most 1000"),
        ("move(a=1, 2)", 1, "move", "without a name"),
        ("def f():\n def g(a):\n end\n g()\nend", 4, "g", "a is missing"),
        ("def f():\n def g(a):\n end\n g(1, 2)\nend", 4, "g", "takes 1"),
        ("def f():\n def g(a):\n end\n g(b=2)\nend", 4, "b", "no such argument"),
        ("def f():\n def g(a):\n end\n g(1, a=2)\nend", 4, "a", "twice"),
        ("def f():\n def g(a, a):\n end\nend", 2, "a", "two parameters"),
        ("def f():\n def g(a=1, b):\n end\nend", 2, "b", "without a default"),
        ("def f():\n def g():\n end\n def g():\n end\nend", 4, "g", "defined twice"),
        ("def f():\n def g():\n end\n run g()\nend", 4, "g", "only a thread"),
        ("def f():\n thread g():\n end\n g()\nend", 4, "g", "started with run"),
        ("run move(1)", 1, "move", "only a thread"),
        ("def f():\n sec g():\n end\nend", 2, "g", "secondary"),
        ("def f(a):\nend", 1, "a", "no arguments"),
        ("def f():\nend\nmove(1)", 3, "move", "ended before"),
        ("def f():\n x = 1", 2, "", "program is incomplete.*end"),
        ("end", 1, "end", "cannot stand here"),
        ("x = ", 1, "", "program is incomplete"),
        ("x = 1 +", 1, "", "program is incomplete"),
        ("x = 1 2", 1, "2", "cannot stand here"),
        ("x", 1, "", "program is incomplete"),
        ("break", 1, "break", "outside of any loop"),
        ("while True:\n def g():\n  continue\n end\nend", 3, "continue", "outside of any loop"),
        ("x = 2147483648", 1, "2147483648", "32 bits"),
        ("x = " + "9" * 5000, 1, "9" * 5000, "32 bits"),
        ("x = 1e999", 1, "1e999", "too large"),
        ("x = p[1, 2, 3]", 1, "p", "6 numbers"),
        ("x = [1]\nx[0, 0, 0] = 1", 2, "x", "1 or 2 indices"),
        ("x = [1]\nx[0][0] = 1", 2, "x", "one element"),
        ("if = 1", 1, "=", "cannot stand here"),
        ("x = end", 1, "end", "cannot stand here"),
        ("x = 1\ny = x ? 2", 2, "?", "no URScript starts with this"),
        ("x = 'a'", 1, "'", "no URScript starts with this"),
        ('x = "a', 1, '"', "no URScript starts with this"),
        ("x = 2y", 1, "2", "no URScript starts with this"),
        ("def f():\n def g(a):\n  global a = 1\n end\nend", 3, "a", "both global and local"),
    ],
)
def test_refusals_name_line_and_word(text: str, line: int, word: str, reason: str) -> None:
    with pytest.raises(ScriptSyntaxError, match=reason) as caught:
        parse(text, BUILTINS)
    assert (caught.value.line, caught.value.word) == (line, word)
    assert text.splitlines()[line - 1].startswith(word, caught.value.column - 1)


@pytest.mark.parametrize(
    "text",
    [
        '__import__("os")',
        'open("/etc/passwd")',
        'eval("1")',
        "x = __builtins__",
        "x = __name__",
        "x = n_run",
        "x = b_move",
        "n_halt()",
        "f_()",
        "x = [1].append",
        "x = move.__globals__",
        "x = (1).real",
        "move.x = 1",
        "x = move",
        "import os",
        "x = lambda: 1",
        "x = {}",
        "x = `1`",
        "x = [1][0:1]",
        "x = 1 if True else 2",
        "def f():\n yield 1\nend",
        "del x",
        "assert 1",
        "x = 1; y = 2",
        "x = 2 ** 3",
        "x := 1",
        "@move\ndef f():\nend",
        "x = n_steps",
        "move(*[1])",
    ],
)
def test_programs_cannot_reach_python(text: str) -> None:
    with pytest.raises(ScriptSyntaxError):
        parse(text, BUILTINS)


def test_names_of_python_are_ordinary_variables() -> None:
    text = "__builtins__ = 1\n__class__ = 2\nn_steps = 3\nglobal g_x = __builtins__ + __class__ + n_steps\nsay(g_x)"
    said: list[object] = []
    builtins = {"say": said.append}
    Machine(parse(text, builtins), builtins, steps_per_tick=100).tick()
    assert said == [6]


@pytest.mark.parametrize(
    "text",
    [
        "x = " + "(" * 5000 + "1" + ")" * 5000,
        "x = " + "-" * 5000 + "1",
        "x = " + "not " * 5000 + "True",
        "x = " + "1 + " * 5000 + "1",
        "x = " + "[" * 5000 + "]" * 5000,
        "x = " + "sin(" * 5000 + "1" + ")" * 5000,
        "x = [1]\ny = x" + "[0]" * 5000,
        "if True:\n" * 5000 + "end\n" * 5000,
        "while True:\n" * 30 + "end\n" * 30,
        "def f():\n" * 500 + "end\n" * 500,
        "if True:\n" + "elif True:\n" * 5000 + "end\n",
    ],
)
def test_programs_that_are_nested_too_deeply_are_refused(text: str) -> None:
    try:
        parsed = parse(text, BUILTINS)
    except ScriptSyntaxError:
        return
    assert "(((" in text  # brackets alone are no nesting
    Machine(parsed, BUILTINS, steps_per_tick=10).tick()


SEED = """def prog():
  global target = [0, 0, 0, 0, 0, 0]
  global busy = 0
  pose = p[0.1, 0, 0, 0, 0, 3.1]
  def scale(q, by=2.0):
    i = 0
    while i < length(q):
      q[i] = q[i] * by
      i = i + 1
    end
    return q
  end
  thread worker(n):
    while True:
      enter_critical
      t = target
      exit_critical
      if n > 3 and not busy == 1:
        move(t, a=1.0, v=n / 2)
      elif n == 0 or t[0] >= 5:
        break
      else:
        sync()
      end
      n = n - 1
    end
  end
  h = run worker(5)
  target = scale([1, 2, 3, 4, 5, 6], by=1.5)
  sleep(0.1)
  m = [[1, 2], [3, 4]]
  m[0, 1] = m[1, 0] % 3 - -1
  s = str_cat("a", to_str(m[0, 1]))
  kill h
  join h
  x = norm(pose_trans(pose, pose)) xor True
  halt
end
"""
WORDS = re.findall(r'"[^"]*"|[A-Za-z_]\w*|[\d.]+|\s+|[^\s\w]+', SEED)
OTHER = [
    "\n",
    "(",
    ")",
    "[",
    "]",
    ",",
    "=",
    "-1",
    "0",
    "1e308",
    "2147483647",
    '"',
    "end",
    "def",
    "run",
    "p[",
    "__class__",
]


def mutated(chance: random.Random) -> str:
    words = list(WORDS)
    for _ in range(chance.randint(1, 4)):
        place = chance.randrange(len(words))
        match chance.randrange(4):
            case 0:
                del words[place]
            case 1:
                words[place] = chance.choice(WORDS)
            case 2:
                words.insert(place, chance.choice(OTHER))
            case _:
                words[place] = words[place][::-1]
    return "".join(words)


def test_the_seed_of_the_mutations_runs() -> None:
    machine = Machine(parse(SEED, BUILTINS), BUILTINS, steps_per_tick=300)
    for _ in range(30):
        machine.tick()
    assert machine.finished


def test_mutated_programs_are_refused_or_run() -> None:
    chance = random.Random(1)
    counts = {"refused": 0, "stopped": 0, "ran": 0}
    for _ in range(100_000 if SOAK else 800):
        text = mutated(chance)
        try:
            machine = Machine(parse(text, BUILTINS), BUILTINS, steps_per_tick=300)
        except ScriptSyntaxError:
            counts["refused"] += 1
            continue
        try:
            for _ in range(20):
                machine.tick()
        except ScriptRuntimeError:
            counts["stopped"] += 1
        else:
            counts["ran"] += 1
        machine.kill()
    assert min(counts.values()) > 0.005 * sum(counts.values())


def test_names_of_arguments_are_compared_a_bounded_number_of_times(monkeypatch):
    compared = 0

    def equal(self, other):
        nonlocal compared
        compared += 1
        return str.__eq__(self, other)

    monkeypatch.setattr(Token, "__eq__", equal)
    with pytest.raises(ScriptSyntaxError):
        parse("move(" + ", ".join(f"a{number}=1" for number in range(500)) + ")", BUILTINS)
    assert compared < 20_000


def test_long_numbers_are_read_without_backtracking() -> None:
    """It would take a time that grows with the square of their digits."""
    (pattern,) = (each.pattern.value for each in _LARK.terminals if each.name == "NUMBER")
    assert not re.search(r"\\d[+*](?!\+)", pattern)
    with pytest.raises(ScriptSyntaxError):
        parse("x = " + 200_000 * "1" + "x", BUILTINS)
