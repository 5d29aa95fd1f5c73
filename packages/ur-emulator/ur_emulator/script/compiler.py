"""Compiler from the syntax tree of a program to Python code.

Each function becomes a Python function of the same structure: a generator if it may block, else a plain function.
Names of the program never become Python names: variables begin with `v_` or, if global, with `g_`, functions with
`f_`, builtins with `b_`, and functions of the machine with `n_`. Nothing else can be named and no attribute can be
written, so a program reaches its builtins and nothing of Python. Every node carries line and column of its word, so
Python's own tables locate the failure of a running program.

`n_steps` counts down the statements that a thread may still run in this control period: a loop takes the number of
its statements per iteration, a function one per call. Where long statements or many of them stand in either, it takes
one more for every `EXPRESSIONS` in them, so that the time of a control period stays bounded.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from types import CodeType
from typing import Any, Final

from lark import Token

from ur_emulator.script import syntax
from ur_emulator.script.calls import Calls, interface
from ur_emulator.script.operations import OPERATIONS
from ur_emulator.script.scopes import Function, Names
from ur_emulator.script.values import Builtins

FILE: Final = "<URScript>"
"""File name of the code, by which its frames are recognised."""

MAIN: Final = "f_"
"""Name of the program's main function. No function of a program has this name."""

EXPRESSIONS: Final = 64
"""Expressions that count for one more statement: elements, operands and calls."""

# Identifiers of the operations in the code.
NAMES: Final = {word: f"n_op{index}" for index, word in enumerate(OPERATIONS)}

_EQUALITY: Final = {"==": ast.Eq, "!=": ast.NotEq}
_LOGIC: Final = {"and": ast.And, "or": ast.Or}
_WITHOUT_EFFECT: Final = ("pass", "enter_critical", "exit_critical")  # see `Machine`
_LOAD: Final = ast.Load()
_STORE: Final = ast.Store()


def generate(program: syntax.Define, names: Names, calls: Calls, builtins: Builtins) -> CodeType:
    """Return the code of a program: a module that defines its main function, `MAIN`.

    Raises:
        ScriptSyntaxError: A variable is never assigned, or a statement stands where it must not.
    """
    main = _FunctionCompiler(names, calls, builtins, names.functions[id(program)]).function(MAIN, [], [])
    return compile(ast.Module(body=[main], type_ignores=[]), FILE, "exec")


class _FunctionCompiler:
    """Compiler of one function."""

    def __init__(self, names: Names, calls: Calls, builtins: Builtins, function: Function) -> None:
        self._names, self._calls, self._builtins, self._function = names, calls, builtins, function
        self._places: dict[str, str | None] = {}
        self._rebinds: dict[str, set[str]] = {"global": {"n_steps"}, "outer": set()}
        self._loops = 0

    def function(self, name: str, parameters: list[str], defaults: list[ast.expr]) -> ast.FunctionDef:
        """Return the definition of the function in Python."""
        function, where = self._function, _where(self._function.define.at)
        body = self._block(function.define.body)
        start = self._step(function.define.at, 1 + _expressions(function.define.body) // EXPRESSIONS)
        if function.define.kind == "thread" or function.parent is None:
            # Force a generator, whatever the body is.
            never = ast.Expr(ast.Yield(None, **where), **where)
            start.append(ast.If(ast.Constant(False, **where), [never], [], **where))
        if function.recursive:
            start.append(_do(where, "n_deeper"))
            body = [ast.Try(body, [], [], [_do(where, "n_shallower")], **where)]
        start.insert(0, ast.Global(sorted(self._rebinds["global"]), **where))
        if self._rebinds["outer"]:
            start.insert(0, ast.Nonlocal(sorted(self._rebinds["outer"]), **where))
        arguments = ast.arguments(
            posonlyargs=[],
            args=[ast.arg(parameter, **where) for parameter in parameters],
            kwonlyargs=[],
            kw_defaults=[],
            defaults=defaults,
        )
        return ast.FunctionDef(name, arguments, start + body, [], **where)

    def _step(self, word: Token, count: int) -> list[ast.stmt]:
        where = _where(word)
        steps = ast.Name("n_steps", _LOAD, **where)
        spent = ast.Compare(steps, [ast.Lt()], [ast.Constant(0, **where)], **where)
        return [
            ast.AugAssign(ast.Name("n_steps", _STORE, **where), ast.Sub(), ast.Constant(count, **where), **where),
            ast.If(spent, [_do(where, "n_endless")], [], **where),
        ]

    def _block(self, body: list[syntax.Statement]) -> list[ast.stmt]:
        code: list[ast.stmt] = []
        for statement in body:
            code += _STATEMENTS[type(statement)](self, statement)
        return code or [ast.Pass(lineno=1, col_offset=0, end_lineno=1, end_col_offset=0)]

    def _assign(self, node: syntax.Assign) -> list[ast.stmt]:
        where, name = _where(node.at), str(node.at)
        place = self._place(name)
        value = self._expression(node.value)
        if node.items:
            if place is None:
                return [ast.Expr(self._output(node, value), **where)]
            operation = "put" if len(node.items) == 1 else "put_cell"
            # The value first: its calls may change the list.
            arguments = [value, self._variable(node.at), *map(self._expression, node.items)]
            value = _operation(where, operation, arguments)
        elif node.qualifier == "local":
            place = "own"
        target = ast.Name(_mangled(name, place or ""), _STORE, **where)
        if place != "own":
            self._rebinds[place or ""].add(target.id)
        return [ast.Assign([target], value, **where)]

    def _output(self, node: syntax.Assign, value: ast.expr) -> ast.expr:
        # digital_out[n] = value: the syntax of old programs.
        builtin = f"set_{node.at}"
        if node.at != "digital_out" or builtin not in self._builtins or len(node.items) != 1:
            raise syntax.unknown(node.at, "nothing assigns this variable")
        self._calls.used.setdefault(builtin, interface(self._builtins[builtin]))
        where = _where(node.at)
        return ast.Call(ast.Name("b_" + builtin, _LOAD, **where), [self._expression(node.items[0]), value], [], **where)

    def _if(self, node: syntax.If) -> list[ast.stmt]:
        code = self._block(node.otherwise) if node.otherwise else []
        for word, condition, body in reversed(node.branches):
            code = [ast.If(self._condition(condition), self._block(body), code, **_where(word))]
        return code

    def _while(self, node: syntax.While) -> list[ast.stmt]:
        self._loops += 1
        more = (_weight(node.condition) + _expressions(node.body)) // EXPRESSIONS
        body = self._step(node.at, 1 + _size(node.body) + more) + self._block(node.body)
        self._loops -= 1
        return [ast.While(self._condition(node.condition), body, [], **_where(node.at))]

    def _simple(self, node: syntax.Simple) -> list[ast.stmt]:
        where = _where(node.at)
        if node.at == "halt":
            return [_do(where, "n_halt")]
        if node.at in _WITHOUT_EFFECT:
            return [ast.Pass(**where)]
        if not self._loops:
            raise syntax.error(node.at, "it is outside of any loop")
        return [ast.Break(**where) if node.at == "break" else ast.Continue(**where)]

    def _return(self, node: syntax.Return) -> list[ast.stmt]:
        value = None if node.value is None else self._expression(node.value)
        return [ast.Return(value, **_where(node.at))]

    def _kill(self, node: syntax.Kill) -> list[ast.stmt]:
        where = _where(node.at)
        call = ast.Call(ast.Name(f"n_{node.at}", _LOAD, **where), [self._expression(node.value)], [], **where)
        return [ast.Expr(ast.YieldFrom(call, **where) if node.at == "join" else call, **where)]

    def _define(self, node: syntax.Define) -> list[ast.stmt]:
        body = _FunctionCompiler(self._names, self._calls, self._builtins, self._names.functions[id(node)])
        parameters = [_mangled(str(name), "own") for name, _ in node.parameters]
        defaults: list[ast.expr] = []
        for name, default in node.parameters:
            if default is not None:
                defaults.append(self._expression(default))
            elif defaults:
                raise syntax.error(name, "parameters without a default stand before those with one")
        return [body.function(f"f_{node.at}", parameters, defaults)]

    def _do_call(self, node: syntax.Call) -> list[ast.stmt]:
        return [ast.Expr(self._call(node), **_where(node.at))]

    def _expression(self, node: syntax.Expression) -> ast.expr:
        return _EXPRESSIONS[type(node)](self, node)

    def _condition(self, node: syntax.Expression) -> ast.expr:
        value = self._expression(node)
        match node:
            case syntax.Binary():
                if node.at not in "+-*/%":
                    return value
            case syntax.Unary():
                if node.at == "not":
                    return value
            case syntax.Number():
                if isinstance(node.value, bool):
                    return value
        return _operation(_where(node.at), "truth", [value])

    def _constant(self, node: syntax.Number | syntax.Text) -> ast.expr:
        return ast.Constant(node.value, **_where(node.at))

    def _name(self, node: syntax.Name) -> ast.expr:
        return self._variable(node.at)

    def _variable(self, word: Token) -> ast.expr:
        place = self._place(str(word))
        if place is None:
            raise syntax.unknown(word, "nothing assigns this variable")
        return ast.Name(_mangled(str(word), place), _LOAD, **_where(word))

    def _place(self, name: str) -> str | None:
        if name not in self._places:
            self._places[name] = self._names.place(name, self._function)
        return self._places[name]

    def _call(self, node: syntax.Call) -> ast.expr:
        where, name = _where(node.at), str(node.at)
        target = self._function.find(name)
        arguments = [self._expression(each) for each in node.arguments]
        prefix = "" if target is None else "v_"
        keywords = [
            ast.keyword(prefix + word, self._expression(value), **_where(word)) for word, value in node.keywords
        ]
        callee = ast.Name(("b_" if target is None else "f_") + name, _LOAD, **where)
        if node.runs:
            return ast.Call(ast.Name("n_run", _LOAD, **where), [callee, *arguments], keywords, **where)
        call = ast.Call(callee, arguments, keywords, **where)
        blocks = self._calls.used[name].blocks if target is None else target.blocks
        return ast.YieldFrom(call, **where) if blocks else call

    def _index(self, node: syntax.Index) -> ast.expr:
        arguments = [self._expression(node.base), *map(self._expression, node.items)]
        return _operation(_where(node.at), "get" if len(node.items) == 1 else "get_cell", arguments)

    def _list(self, node: syntax.ListOf) -> ast.expr:
        items = [self._expression(item) for item in node.items]
        return _operation(_where(node.at), "pose" if node.is_pose else "list", items)

    def _unary(self, node: syntax.Unary) -> ast.expr:
        where = _where(node.at)
        if node.at == "not":
            return ast.UnaryOp(ast.Not(), self._condition(node.operand), **where)
        return _operation(where, "negative", [self._expression(node.operand)])

    def _binary(self, node: syntax.Binary) -> ast.expr:
        where, operator = _where(node.at), str(node.at)
        if operator in _LOGIC:
            return ast.BoolOp(_LOGIC[operator](), [self._condition(node.left), self._condition(node.right)], **where)
        if operator == "xor":
            left, right = self._condition(node.left), self._condition(node.right)
            return ast.Compare(left, [ast.NotEq()], [right], **where)
        left, right = self._expression(node.left), self._expression(node.right)
        if operator in _EQUALITY:
            return ast.Compare(left, [_EQUALITY[operator]()], [right], **where)
        return _operation(where, operator, [left, right])


_STATEMENTS: Final[dict[type, Callable[[_FunctionCompiler, Any], list[ast.stmt]]]] = {
    syntax.Assign: _FunctionCompiler._assign,
    syntax.Call: _FunctionCompiler._do_call,
    syntax.Define: _FunctionCompiler._define,
    syntax.If: _FunctionCompiler._if,
    syntax.Kill: _FunctionCompiler._kill,
    syntax.Return: _FunctionCompiler._return,
    syntax.Simple: _FunctionCompiler._simple,
    syntax.While: _FunctionCompiler._while,
}
_EXPRESSIONS: Final[dict[type, Callable[[_FunctionCompiler, Any], ast.expr]]] = {
    syntax.Binary: _FunctionCompiler._binary,
    syntax.Call: _FunctionCompiler._call,
    syntax.Index: _FunctionCompiler._index,
    syntax.ListOf: _FunctionCompiler._list,
    syntax.Name: _FunctionCompiler._name,
    syntax.Number: _FunctionCompiler._constant,
    syntax.Text: _FunctionCompiler._constant,
    syntax.Unary: _FunctionCompiler._unary,
}


def _where(word: Token) -> dict[str, Any]:
    line, column = word.line or 1, (word.column or 1) - 1
    return {"lineno": line, "col_offset": column, "end_lineno": line, "end_col_offset": column + len(word)}


def _operation(where: dict[str, Any], name: str, arguments: list[ast.expr]) -> ast.expr:
    return ast.Call(ast.Name(NAMES[name], _LOAD, **where), arguments, [], **where)


def _do(where: dict[str, Any], name: str) -> ast.stmt:
    return ast.Expr(ast.Call(ast.Name(name, _LOAD, **where), [], [], **where), **where)


def _mangled(name: str, place: str) -> str:
    return ("g_" if place == "global" else "v_") + name


def _size(body: list[syntax.Statement]) -> int:
    """Count the statements of a block, without those of nested loops, which count for themselves."""
    count = len(body)
    for node in body:
        if isinstance(node, syntax.If):
            count += max([_size(block) for _, _, block in node.branches] + [_size(node.otherwise)])
    return count


def _expressions(body: list[syntax.Statement]) -> int:
    """Count the expressions of a block, without those of nested loops and functions, which count for themselves."""
    count = 0
    for node in body:
        match node:
            case syntax.If():
                count += sum(_weight(condition) for _, condition, _ in node.branches)
                count += max([_expressions(block) for _, _, block in node.branches] + [_expressions(node.otherwise)])
            case syntax.Assign():
                count += _weight(node.value) + sum(map(_weight, node.items))
            case syntax.Call():
                count += _weight(node)
            case syntax.Return() | syntax.Kill():
                count += 0 if node.value is None else _weight(node.value)
    return count


def _weight(node: syntax.Expression) -> int:
    """Count the expressions within one, and itself."""
    match node:
        case syntax.Call():
            return 1 + sum(map(_weight, node.arguments)) + sum(_weight(value) for _, value in node.keywords)
        case syntax.Index():
            return 1 + _weight(node.base) + sum(map(_weight, node.items))
        case syntax.ListOf():
            return 1 + sum(map(_weight, node.items))
        case syntax.Unary():
            return 1 + _weight(node.operand)
        case syntax.Binary():
            return 1 + _weight(node.left) + _weight(node.right)
        case _:
            return 1
