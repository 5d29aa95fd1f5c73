"""Scopes: the functions of a program, and the variables that its names refer to.

A name that is declared `global` anywhere in the program is global, except where it is a parameter or declared `local`.
A name that an enclosing function assigns (above all the program itself) is that function's variable, for assignments
too: drivers share set-points between the program's threads in this way, without any declaration. All other names that
a function assigns are its own.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from lark import Token

from ur_emulator.script import syntax

DEPTH_MAX: Final = 60
"""Greatest nesting depth of expressions and blocks."""

LOOPS_MAX: Final = 12
"""Greatest nesting depth of loops within one function."""

BRANCHES_MAX: Final = 300
"""Most branches of one `if`."""


FUNCTIONS_MAX: Final = 1000
"""Most functions and threads of a program. The time of Python's compiler grows with the square of their number."""


@dataclass(slots=True, eq=False)
class Function:
    """Function, thread or the program itself, with the names in it.

    Attributes:
        define: Its node.
        parent: Enclosing function.
        parameters: Names of its parameters.
        local: Names declared `local` in it.
        free: Names that it assigns without a declaration.
        declared: Names that it declares `global`, with the words that do.
        functions: Functions defined in it, by name.
        calls: Calls and thread starts in it.
        blocks: Whether a call of it may take a control period or more.
        recursive: Whether it may call itself, directly or not.
    """

    define: syntax.Define
    parent: Function | None
    parameters: set[str] = field(default_factory=set)
    local: set[str] = field(default_factory=set)
    free: set[str] = field(default_factory=set)
    declared: dict[str, Token] = field(default_factory=dict)
    functions: dict[str, Function] = field(default_factory=dict)
    calls: list[syntax.Call] = field(default_factory=list)
    blocks: bool = False
    recursive: bool = False

    def owns(self, name: str) -> bool:
        """Return True if functions within this one refer to its variable by that name."""
        return name in self.parameters or name in self.local or name in self.free

    def find(self, name: str) -> Function | None:
        """Return the function that a call from here refers to."""
        scope: Function | None = self
        while scope is not None:
            if name in scope.functions:
                return scope.functions[name]
            scope = scope.parent
        return None


class Names:
    """All functions of a program, and the scope of its variables.

    Attributes:
        functions: Functions by the identity of their node; the program itself is the first.
        shared: Names declared `global` anywhere.

    Raises:
        ScriptSyntaxError: A name is declared in two ways, or the nesting is too deep.
    """

    def __init__(self, program: syntax.Define) -> None:
        self.functions: dict[int, Function] = {}
        self.shared: set[str] = set()
        self._define(program, None, 0)
        for function in self.functions.values():
            for name in function.declared.keys() & (function.parameters | function.local):
                raise syntax.error(function.declared[name], f"in {function.define.at} it is both global and local")

    def place(self, name: str, function: Function) -> str | None:
        """Return the scope of a variable: "global", "own", "outer", or None if nothing assigns it."""
        if name in function.parameters or name in function.local:
            return "own"
        if name in self.shared:
            return "global"
        outer = function.parent
        while outer is not None:
            if outer.owns(name):
                return "outer"
            outer = outer.parent
        return "own" if name in function.free else None

    def _define(self, node: syntax.Define, parent: Function | None, depth: int) -> None:
        if len(self.functions) > FUNCTIONS_MAX:
            raise syntax.error(node.at, f"a program has at most {FUNCTIONS_MAX} functions and threads")
        function = Function(node, parent)
        self.functions[id(node)] = function
        if parent is not None:
            if node.kind == "sec":
                raise syntax.error(node.at, "a secondary program cannot be defined within another")
            if node.at in parent.functions:
                raise syntax.error(node.at, "it is defined twice")
            parent.functions[str(node.at)] = function
        for name, default in node.parameters:
            if name in function.parameters:
                raise syntax.error(name, "two parameters have this name")
            function.parameters.add(str(name))
            if default is not None and parent is not None:
                self._expressions((default,), parent, depth + 1)
        self._block(node.body, function, depth + 1, 0)

    def _block(self, body: list[syntax.Statement], function: Function, depth: int, loops: int) -> None:
        for statement in body:
            if depth > DEPTH_MAX:
                raise syntax.error(statement.at, f"blocks are nested more than {DEPTH_MAX} deep")
            self._statement(statement, function, depth, loops)

    def _statement(self, node: syntax.Statement, function: Function, depth: int, loops: int) -> None:
        match node:
            case syntax.Assign():
                if not node.items:
                    self._assigned(node, function)
                self._expressions((*node.items, node.value), function, depth)
            case syntax.Call():
                self._expressions((node,), function, depth)
            case syntax.If():
                if len(node.branches) > BRANCHES_MAX:
                    raise syntax.error(node.at, f"it has more than {BRANCHES_MAX} branches")
                for _, condition, body in node.branches:
                    self._expressions((condition,), function, depth)
                    self._block(body, function, depth + 1, loops)
                self._block(node.otherwise, function, depth + 1, loops)
            case syntax.While():
                if loops >= LOOPS_MAX:
                    raise syntax.error(node.at, f"loops are nested more than {LOOPS_MAX} deep")
                self._expressions((node.condition,), function, depth)
                self._block(node.body, function, depth + 1, loops + 1)
            case syntax.Return() | syntax.Kill():
                if node.value is not None:
                    self._expressions((node.value,), function, depth)
            case syntax.Define():
                self._define(node, function, depth)

    def _assigned(self, node: syntax.Assign, function: Function) -> None:
        name = str(node.at)
        if node.qualifier == "global":
            self.shared.add(name)
            function.declared.setdefault(name, node.at)
        elif node.qualifier == "local":
            function.local.add(name)
        else:
            function.free.add(name)

    def _expressions(self, nodes: Iterable[syntax.Expression], function: Function, depth: int) -> None:
        for node in nodes:
            if isinstance(node, (syntax.Number, syntax.Text, syntax.Name)):
                continue
            if depth > DEPTH_MAX:
                raise syntax.error(node.at, f"expressions are nested more than {DEPTH_MAX} deep")
            inner: Iterable[syntax.Expression]
            match node:
                case syntax.Call():
                    function.calls.append(node)
                    inner = [*node.arguments, *(value for _, value in node.keywords)]
                case syntax.Index():
                    inner = [node.base, *node.items]
                case syntax.ListOf():
                    inner = node.items
                case syntax.Unary():
                    inner = (node.operand,)
                case syntax.Binary():
                    inner = (node.left, node.right)
            self._expressions(inner, function, depth + 1)
