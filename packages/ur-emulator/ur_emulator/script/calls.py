"""Call analysis: blocking and recursive functions, and the fit of arguments to parameters."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

from ur_emulator.script import syntax
from ur_emulator.script.manual import NAMES
from ur_emulator.script.scopes import Function, Names
from ur_emulator.script.values import Builtins, VersionBuiltins


class Interface(NamedTuple):
    """Part of a builtin on which the code of a program depends. It can stand in for the builtin in another process.

    Attributes:
        blocks: Whether it blocks.
        signature: Its parameters.
    """

    blocks: bool
    signature: inspect.Signature


def interface(builtin: Callable[..., Any] | Interface) -> Interface:
    """Return the interface of a builtin."""
    if isinstance(builtin, Interface):
        return builtin
    return Interface(inspect.isgeneratorfunction(builtin), inspect.signature(builtin))


class Calls:
    """Checked calls of a program.

    Attributes:
        used: Interfaces of the builtins that the program calls, by name.

    Raises:
        ScriptSyntaxError: A call names an unknown function, or its arguments do not fit.
    """

    def __init__(self, names: Names, builtins: Builtins) -> None:
        self.used: dict[str, Interface] = {}
        self._builtins = builtins
        callers: dict[int, list[Function]] = {}
        callees: dict[int, list[Function]] = {}
        blocking: list[Function] = []
        for function in names.functions.values():
            if function.parent is None or _joins(function.define.body):
                function.blocks = True
                blocking.append(function)
            for call in function.calls:
                target = function.find(str(call.at))
                if target is None:
                    if self._builtin(call) and not function.blocks:
                        function.blocks = True
                        blocking.append(function)
                    continue
                _fit(call, target)
                if not call.runs:
                    callers.setdefault(id(target), []).append(function)
                    callees.setdefault(id(function), []).append(target)
        while blocking:
            for caller in callers.get(id(blocking.pop()), ()):
                if not caller.blocks:
                    caller.blocks = True
                    blocking.append(caller)
        _mark_recursive(names, callers, callees)

    def _builtin(self, call: syntax.Call) -> bool:
        """Check the call of a builtin and return whether it blocks."""
        name = str(call.at)
        if name not in self._builtins:
            absent = self._builtins.absent if isinstance(self._builtins, VersionBuiltins) else {}
            if name in absent or name in NAMES:
                raise syntax.error(call.at, absent.get(name, "this function of UR's manual is not emulated"))
            raise syntax.unknown(call.at, "there is no such function")
        if call.runs:
            raise syntax.error(call.at, "only a thread can be run")
        if name not in self.used:
            self.used[name] = interface(self._builtins[name])
        used = self.used[name]
        try:
            used.signature.bind(*call.arguments, **{str(key): None for key, _ in call.keywords})
        except TypeError as error:
            raise syntax.error(call.at, str(error)) from None
        return used.blocks


def _joins(body: list[syntax.Statement]) -> bool:
    for node in body:
        match node:
            case syntax.Kill():
                if node.at == "join":
                    return True
            case syntax.If():
                if _joins(node.otherwise) or any(_joins(block) for _, _, block in node.branches):
                    return True
            case syntax.While():
                if _joins(node.body):
                    return True
    return False


def _fit(call: syntax.Call, function: Function) -> None:
    is_thread = function.define.kind == "thread"
    if call.runs != is_thread:
        raise syntax.error(call.at, "a thread is started with run" if is_thread else "only a thread can be run")
    parameters = [str(name) for name, _ in function.define.parameters]
    if len(call.arguments) > len(parameters):
        raise syntax.error(call.at, f"it takes {len(parameters)} arguments, found {len(call.arguments)}")
    given = set(parameters[: len(call.arguments)])
    for word, _ in call.keywords:
        if word not in function.parameters:
            raise syntax.error(word, f"{call.at} has no such argument: use one of {', '.join(parameters) or '(none)'}")
        if word in given:
            raise syntax.error(word, f"the argument is given twice to {call.at}")
        given.add(str(word))
    for name, default in function.define.parameters:
        if default is None and name not in given:
            raise syntax.error(call.at, f"its argument {name} is missing")


def _mark_recursive(names: Names, callers: dict[int, list[Function]], callees: dict[int, list[Function]]) -> None:
    # Remove functions that call nothing that is left. The rest are in a cycle, or lead into one.
    open_calls = {id(function): len(callees.get(id(function), ())) for function in names.functions.values()}
    done = [function for function in names.functions.values() if not open_calls[id(function)]]
    for function in names.functions.values():
        function.recursive = True
    while done:
        function = done.pop()
        function.recursive = False
        for caller in callers.get(id(function), ()):
            open_calls[id(caller)] -= 1
            if not open_calls[id(caller)]:
                done.append(caller)
