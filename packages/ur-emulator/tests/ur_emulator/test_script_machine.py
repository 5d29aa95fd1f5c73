"""URScript runs as on UR's controllers: statements, scopes, values, threads, and errors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from ur_core.errors import MotionError, ScriptRuntimeError, ScriptSyntaxError, SettingsError
from ur_emulator.script import Machine, Pose, Program, library, parse

TICK_S = 0.008


class Robot:
    """Builtins that record their calls."""

    def __init__(self) -> None:
        self.said: list[Any] = []
        self.released: list[str] = []
        self.machine: Machine | None = None
        self.builtins = {
            **library(TICK_S),
            "say": self.said.append,
            "move": self.move,
            "fail": self.fail,
            "give": lambda: [1, 2, 3],
            "set_digital_out": lambda n, b: self.said.append((n, b)),
            "keyed": lambda q, a=1.4, v=1.05: self.said.append((q, a, v)),
            "who": lambda: self.said.append(self.machine.thread if self.machine else None),
            "stop_all": lambda: self.machine and self.machine.kill(),
        }

    def move(self, ticks: int = 1, name: str = "") -> Iterator[None]:
        try:
            for _ in range(ticks):
                yield
        except GeneratorExit:
            self.released.append(name)
            raise

    def fail(self, reason: str) -> None:
        raise MotionError(reason)

    def start(self, text: str, steps: int = 1000) -> Machine:
        self.machine = Machine(parse(text, self.builtins), self.builtins, steps_per_tick=steps)
        return self.machine

    def run(self, text: str, ticks: int = 50, steps: int = 1000) -> list[Any]:
        machine = self.start(text, steps)
        for _ in range(ticks):
            machine.tick()
        assert machine.finished
        return self.said


def tick(machine: Machine, count: int) -> None:
    for _ in range(count):
        machine.tick()


def values(text: str) -> list[Any]:
    return Robot().run(text)


def program(text: str) -> Program:
    return parse(text, Robot().builtins)


def value(expression: str) -> Any:
    (result,) = values(f"def f():\n  a = [1, 2.5, 3]\n  m = [[1, 2], [3, 4]]\n  say({expression})\nend\n")
    return result


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("1 + 2 * 3", 7),
        ("(1 + 2) * 3", 9),
        ("10 - 4 - 3", 3),
        ("-2 - -3", 1),
        ("2 * -3", -6),
        ("7 / 2", 3.5),
        ("6 / 2", 3.0),
        ("7 % 4", 3),
        ("1.5e3", 1500.0),
        (".5", 0.5),
        ("1.", 1.0),
        ("1e-10", 1e-10),
        ("True", True),
        ("not True or True", True),
        ("not (True or True)", False),
        ("True or False and False", True),
        ("True xor True", False),
        ("True xor False", True),
        ("True or True xor True", True),
        ("False and True xor True", True),
        ("not 1 == 2", True),
        ("1 < 2", True),
        ("2 <= 2", True),
        ("3 > 4", False),
        ("4 >= 4", True),
        ("1 != 2", True),
        ("1 + 1 == 2 and 3 > 2", True),
        ("True == 1", True),
        ('"a" == "a"', True),
        ("[1, 2] == [1, 2]", True),
        ('"# no comment"', "# no comment"),
        ("a[1]", 2.5),
        ("m[1, 0]", 3),
        ("m[1]", [3, 4]),
        ("m[1][0]", 3),
        ("[]", []),
        ("p[1, 2, 3, 4, 5, 6]", [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
        ("p[1, 2, 3, 4, 5, 6][5]", 6.0),
        ("give()[2]", 3),
        ("-a[0]", -1),
        ("length (a)", 3),
    ],
)
def test_expressions(expression: str, expected: Any) -> None:
    found = value(expression)
    assert found == expected
    assert type(found) is (Pose if expression == "p[1, 2, 3, 4, 5, 6]" else type(expected))


def test_p_is_a_variable_where_it_is_indexed() -> None:
    assert values("def f():\n p = [4, 5]\n say(p[1])\n p[0] = 6\n say(p)\n say(p[0,0,0,0,0,1])\nend") == [
        5,
        [6, 5],
        [0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
    ]


def test_words_of_other_languages_are_names() -> None:
    names = ("async", "type", "dir", "sum", "time", "class", "lambda", "None", "print", "yield", "end_of", "iffy")
    body = "".join(f"  {name} = {index}\n  say({name})\n" for index, name in enumerate(names))
    assert values(f"def f():\n{body}end\n") == list(range(len(names)))


def test_branches_and_loops() -> None:
    text = """
def f():
  # a comment
  i = 0
  while True:   # and another
    i = i + 1
    if i == 2:
      continue
    elif i == 4:
      say("four")
    elif i == 6:
      break
    else:
      say(i)
      pass
    end
  end
  if i == 7:
    say("never")
  end
end
"""
    expected = [1, 3, "four", 5]
    assert values(text) == expected
    assert values(text.replace("\n", "\r\n")) == expected


def test_statements_and_lines_are_independent() -> None:
    # A client puts a number in on the line after a comment, before the next statement.
    assert values(
        "def f():\n  global a = # offset\n24    global b = 2\n  say(a) say(b)\n if a == 24: say(3) end\nend"
    ) == [24, 2, 3]


def test_a_bare_return_ends_with_its_line() -> None:
    text = (
        "def f():\n def g(a):\n  if a:\n   return  # now\n   say(0)\n"
        "  end\n  return\n say(0)\n end\n g(True)\n g(False)\nsay(1)\nend"
    )
    assert values(text) == [1]


def test_labels_of_polyscope_are_no_statements() -> None:
    assert values('def f():\n $ 1 "Robot Program"\n  $ 2 "say(1)" "noBreak"\n  say(2)\nend\n') == [2]


def test_statements_without_a_program() -> None:
    found = program("keyed([0], a=1.2, v=0.5)")
    assert (found.name, found.is_secondary) == ("unnamed", False)
    assert values("keyed([0], v=1.2)\nsay(1)\n") == [([0], 1.4, 1.2), 1]
    assert values("digital_out[2]=True") == [(2, True)]
    assert values("") == []


def test_digital_out_may_be_a_variable() -> None:
    assert values("digital_out = [0]\ndigital_out[0] = 1\nsay(digital_out)") == [[1]]


def test_names_and_kinds_of_programs() -> None:
    assert (program("def f():\nend").name, program("\n# x\nsec g():\n say(1)\nend").is_secondary) == ("f", True)


def test_arguments_by_place_name_and_default() -> None:
    text = (
        "def f():\n b0 = 7\n def g(a, b=b0, c=[1]):\n  say([a, b])\n"
        "  say(c)\n end\n g(1)\n g(1, c=2)\n g(c=1, a=2, b=3)\nend"
    )
    assert values(text) == [[1, 7], [1], [1, 7], 2, [2, 3], 1]


def test_lists_are_values() -> None:
    text = """
def f():
  global g = [1, 2, 3]
  def change(x):
    x[0] = 9
    g[1] = 8
    return x
  end
  a = g
  b = a
  b[2] = 7
  say(change(a))
  say(a)
  say(b)
  say(g)
  m = [a, a]
  m[0, 0] = 5
  say(m)
  q = p[0, 0, 0, 0, 0, 0]
  r = q
  r[1] = 1
  say(q[1])
  say(r[1])
end
"""
    assert values(text) == [[9, 2, 3], [1, 2, 3], [1, 2, 7], [1, 8, 3], [[5, 2, 3], [1, 2, 3]], 0.0, 1.0]


def test_the_value_of_an_element_is_found_before_the_list() -> None:
    assert values(
        "def f():\n global a = [0, 0]\n def g():\n  a[1] = 5\n  return 4\n end\n a[0] = g()\n say(a)\nend"
    ) == [[4, 5]]


def test_a_pose_stays_a_pose() -> None:
    (found,) = values("def f():\n a = p[0,0,0,0,0,0]\n a[2] = 1\n say(a)\nend")
    assert type(found) is Pose
    assert type(found[2]) is float


def test_a_global_name_is_global_everywhere() -> None:
    text = "def f():\n def g():\n  a = 2\n end\n def h():\n  global a = 1\n end\n h()\n g()\n say(a)\nend"
    assert values(text) == [2]


def test_parameters_and_locals_hide_globals() -> None:
    text = (
        "def f():\n global a = 1\n def g(a):\n  a = 2\n end\n def h():\n"
        "  local a = 3\n  a = 4\n end\n g(5)\n h()\n say(a)\nend"
    )
    assert values(text) == [1]


def test_program_variables_are_shared_with_functions_and_threads() -> None:
    text = """
def f():
  state = 0
  target = [0, 0]
  def put(x):
    state = x
    target[1] = x
  end
  thread t():
    while state < 5:
      sync()
    end
    say(target)
    state = 6
  end
  run t()
  sync()
  put(5)
  sync()
  say(state)
end
"""
    assert values(text) == [[0, 5], 6]


def test_other_names_are_their_functions_own() -> None:
    with pytest.raises(ScriptSyntaxError, match=r"line 5, 'a': nothing assigns"):
        program("def f():\n def g():\n  a = 1\n end\n say(a)\nend")
    assert values("def f():\n def g(n):\n  a = n\n  if n > 0:\n   g(n - 1)\n  end\n  say(a)\n end\n g(2)\nend") == [
        0,
        1,
        2,
    ]


def test_a_blocking_function_gives_its_value() -> None:
    robot = Robot()
    machine = robot.start(
        "def f():\n def g(x):\n  move(2)\n  return x + 1\n end\n"
        " def h(x):\n  return g(x) * 2\n end\n say(h(1) + g(2))\nend"
    )
    machine.tick()
    machine.tick()
    machine.tick()
    assert robot.said == []
    machine.tick()
    machine.tick()
    assert robot.said == [7]
    assert machine.finished


def test_sync_is_one_tick_and_sleep_whole_ones() -> None:
    for statement, ticks in (
        ("sync()", 1),
        ("sleep(0.008)", 1),
        ("sleep(0.0081)", 2),
        ("sleep(0.8)", 100),
        ("sleep(0)", 0),
    ):
        robot = Robot()
        machine = robot.start(statement)
        for _ in range(ticks):
            machine.tick()
            assert not machine.finished
        machine.tick()
        assert machine.finished


def test_threads_run_in_the_order_of_their_start_and_at_once() -> None:
    text = """
def f():
  thread a(n):
    while True:
      say(n)
      sync()
    end
  end
  thread b():
    run a(2)
    say(1)
  end
  run b()
  run a(3)
  while True:
    say(0)
    sync()
  end
end
"""
    robot = Robot()
    machine = robot.start(text)
    machine.tick()
    assert robot.said == [0, 1, 3, 2]
    machine.tick()
    assert robot.said[4:] == [0, 3, 2]


def test_program_and_threads_end_with_the_main_function() -> None:
    robot = Robot()
    machine = robot.start('def f():\n thread t():\n  move(100, "t")\n end\n run t()\n sync()\nend')
    machine.tick()
    assert (machine.finished, robot.released) == (False, [])
    machine.tick()
    assert (machine.finished, robot.released) == (True, ["t"])
    machine.tick()


def test_kill_and_join() -> None:
    text = """
def f():
  thread t(n):
    move(n, "t")
    say(n)
  end
  a = run t(3)
  b = run t(5)
  c = run t
  kill 0
  sync()
  kill b
  kill b
  join a
  join a
  join b
  say("joined")
end
""".replace("  c = run t\n", "")
    robot = Robot()
    assert robot.run(text) == [3, "joined"]
    assert robot.released == ["t"]


def test_run_needs_no_parentheses() -> None:
    assert values("def f():\n thread t():\n  say(1)\n end\n h = run t\n join h\n say(h)\nend") == [1, 1]


def test_a_thread_may_kill_itself() -> None:
    text = (
        "def f():\n global h = 0\n def g():\n  kill h\n end\n thread t():\n"
        "  g()\n  say(1)\n end\n h = run t()\n join h\n say(2)\nend"
    )
    assert values(text) == [2]


def test_others_run_while_a_thread_waits_in_a_critical_section() -> None:
    text = """
def f():
  thread a():
    while True:
      say("a")
      sync()
    end
  end
  thread b():
    enter_critical
    move(2)
    exit_critical
    say("b")
    sync()
    say("c")
  end
  run b()
  run a()
  say("f")
  move(100)
end
"""
    robot = Robot()
    machine = robot.start(text)
    seen = []
    for _ in range(4):
        machine.tick()
        seen.append(list(robot.said))
        robot.said.clear()
    assert seen == [["f", "a"], ["a"], ["b", "a"], ["c", "a"]]


@pytest.mark.parametrize("end", ["kill h", "pass"])
def test_a_critical_section_ends_with_its_thread(end: str) -> None:
    text = f"def f():\n thread t():\n  enter_critical\n end\n h = run t()\n sync()\n {end}\n sync()\n say(1)\nend"
    assert values(text) == [1]


def test_halt_ends_everything() -> None:
    robot = Robot()
    assert (
        robot.run(
            'def f():\n thread t():\n  move(9, "t")\n end\n run t()\n'
            " sync()\n def g():\n  halt\n end\n g()\n say(1)\nend"
        )
        == []
    )
    assert robot.released == ["t"]


def test_kill_releases_all_builtins_even_from_within_one() -> None:
    robot = Robot()
    text = 'def f():\n thread t():\n  move(9, "t")\n end\n run t()\n move(9, "main")\nend'
    machine = robot.start(text)
    machine.tick()
    machine.kill()
    assert machine.finished
    assert sorted(robot.released) == ["main", "t"]
    robot = Robot()
    machine = robot.start('def f():\n thread t():\n  stop_all()\n  move(1, "t")\n end\n run t()\n move(9, "main")\nend')
    machine.tick()
    assert machine.finished
    assert sorted(robot.released) == ["main", "t"]
    machine.tick()


def test_each_thread_has_an_identity() -> None:
    robot = Robot()
    machine = robot.start("def f():\n thread t():\n  who()\n end\n run t()\n who()\n sync()\n who()\nend")
    machine.tick()
    assert machine.thread is None
    machine.tick()
    main, thread, again = robot.said
    assert main is again
    assert main is not thread
    assert len({main, thread}) == 2


@pytest.mark.parametrize(
    ("before", "repeated"),
    [
        ("", "x = [" + "1, " * 499 + "1]\n x[0] = length([" + "1, " * 499 + "1])"),
        ("", "x = " + " + ".join(["length([" + "1, " * 199 + "1])"] * 5)),
        ("", "if True:\n x = length([" + "1, " * 499 + "1]) + length([" + "1, " * 499 + "1])\n end"),
        ("def f():\n" + "x = 1\n" * 1000 + "end\n", "f()"),
    ],
)
def test_long_statements_and_long_functions_count_for_several(before, repeated):
    robot = Robot()
    machine = robot.start(f"def p():\n{before}while True:\n say(1)\n {repeated}\n end\nend\n", steps=1000)
    with pytest.raises(ScriptRuntimeError, match="infinite loop"):
        machine.tick()
    assert 30 < len(robot.said) < 60  # once per 20 statements or so; 250 times, were each counted as one


@pytest.mark.parametrize(
    ("text", "line", "word", "reason"),
    [
        ("say(1)\nwhile True:\nend", 2, "while", "infinite loop"),
        ("def f():\n def g():\n  return 1\n end\n while True:\n  x = g()\n end\nend", 5, "while", "infinite loop"),
        ("def f():\n def g():\n  g()\n end\n g()\nend", 2, "g", "100 deep"),
        ("def f():\n def g():\n  sync()\n  g()\n end\n g()\nend", 2, "g", "100 deep"),
        ("def f():\n thread t():\n  run t()\n end\n run t()\n sync()\nend", 3, "t", "50 threads"),
        ('say(1)\n fail("too far")', 2, "fail", "too far"),
        ('def f():\n def g(a):\n\n  say(a) fail("x")\n end\n g(1)\nend', 4, "fail", "x"),
        ('say(1 + "a")', 1, "+", "expected a number, found a string"),
        ("say([1] + [2, 3])", 1, "+", "lists of the same length, found 1 and 2"),
        ('say([1] + ["a"])', 1, "+", "expected a number, found a string"),
        ('say("a" * [1])', 1, "*", "found a string"),
        ("say([[1]] + [[2]])", 1, "+", "in this order"),
        ("say([1] * [[2]])", 1, "*", "in this order"),
        ("say([[1, 2]] * [1])", 1, "*", "as many rows on the right as columns on the left: 2"),
        ("say([[1], 2] * [1])", 1, "*", "rows have the same length"),
        ("say([2147483647] + 1)", 1, "+", "32 bits"),
        ("say(p[1, 2, 3, 4, 5, 6] * 2)", 1, "*", "found a pose"),
        ("say(1 / 0)", 1, "/", "division by zero"),
        ("say(1 % 0)", 1, "%", "division by zero"),
        ("a = [1]\nsay(a[1])", 2, "a", "index 1 is outside of 0 to 0"),
        ("a = [1]\nsay(a[-1])", 2, "a", "outside"),
        ("a = [1]\na[1] = 2", 2, "a", "outside"),
        ("a = [1]\nsay(a[0.0])", 2, "a", "expected an integer, found a float"),
        ("a = 1\nsay(a[0])", 2, "a", "only lists"),
        ("a = p[0,0,0,0,0,0]\na[0] = [1]", 2, "a", "expected a number"),
        ("say(2147483647 + 1)", 1, "+", "32 bits"),
        ("say(65536 * 65536)", 1, "*", "32 bits"),
        ('if "a":\nend', 1, '"a"', "a condition is True or False, found a string"),
        ("a = sync()\nif a:\nend", 2, "a", "found nothing"),
        ("a = [[[1]]]", 1, "[", "no lists"),
        ("if False:\n a = 1\nend\nsay(a)", 4, "a", "no value yet"),
        ("def f():\n g()\n def g():\n end\nend", 2, "g", "no value yet"),
        ("def f():\n def g():\n  global a = 1\n end\n say(a)\nend", 5, "a", "no value yet"),
        ('say(sin("a"))', 1, "sin", "expected a number"),
        ("say(sqrt(-1))", 1, "sqrt", "math domain error|nonnegative"),
        ("kill 7", 1, "kill", "handle"),
        ("join [1]", 1, "join", "handle"),
        ("sleep(-1)", 1, "sleep", "0 to 1e9"),
    ],
)
def test_errors_stop_the_program_and_name_line_and_word(text: str, line: int, word: str, reason: str) -> None:
    robot = Robot()
    machine = robot.start(text)
    with pytest.raises(ScriptRuntimeError, match=reason) as caught:
        tick(machine, 300)
    assert (caught.value.line, caught.value.word) == (line, word)
    assert text.splitlines()[line - 1].startswith(word, caught.value.column - 1)
    assert machine.finished
    machine.tick()


def test_mistakes_in_builtins_end_the_program_and_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    robot = Robot()
    robot.builtins["broken"] = lambda: {}.nothing  # type: ignore[attr-defined]
    with pytest.raises(ScriptRuntimeError, match="line 1, 'broken'"):
        robot.run("broken()")
    assert "nothing" in caplog.text


def test_an_endless_loop_with_sync_is_allowed() -> None:
    robot = Robot()
    machine = robot.start("while True:\n sync()\nend", steps=5)
    for _ in range(100):
        machine.tick()
    assert not machine.finished


def test_recursion_depth_is_counted_per_thread() -> None:
    text = (
        "def f():\n def g(n):\n  if n > 0:\n   sync()\n   g(n - 1)\n  end\n end\n"
        " thread t():\n  g(60)\n end\n a = run t()\n g(60)\n g(90)\n join a\n say(1)\nend"
    )
    assert Robot().run(text, ticks=300) == [1]


def test_strings_do_not_grow_without_bound() -> None:
    with pytest.raises(ScriptRuntimeError, match="1023 characters"):
        values('a = "xx"\nwhile True:\n a = str_cat(a, a)\nend')


def test_a_program_needs_builtins_of_the_same_kind() -> None:
    first, second = Robot(), Robot()
    text = "def f():\n move(1)\n say(1)\nend"
    parsed = parse(text, first.builtins)
    machine = Machine(parsed, second.builtins, steps_per_tick=100)
    machine.tick()
    machine.tick()
    assert (first.said, second.said) == ([], [1])
    with pytest.raises(SettingsError, match="'move'"):
        Machine(parsed, {**second.builtins, "move": lambda ticks=1, name="": None}, steps_per_tick=100)
    with pytest.raises(SettingsError, match="steps_per_tick"):
        Machine(parsed, second.builtins, steps_per_tick=0)


def test_the_same_text_is_read_again_for_other_builtins() -> None:
    robot = Robot()
    assert parse("move(1)", robot.builtins) is parse("move(1)", Robot().builtins)
    with pytest.raises(ScriptSyntaxError, match="move"):
        parse("move(1)", {})
    with pytest.raises(ScriptSyntaxError, match="argument"):
        parse("move(1)", {"move": lambda: None})
