"""Compiled kernel, in C++: kinematics, adapter, safety gate, distances, feed-forward, and geometry for tasks.

Python computes all coefficients and owns all memory that lasts; the kernel does the arithmetic of a policy period,
row by row, without the GIL. A `Struct` mirrors one of its structures, whose fields the library itself describes.
"""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Callable
from functools import cache
from math import prod
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ur_core.errors import KernelError
from ur_core.types import Array

FOLDER: Final = Path(__file__).parent
LIBRARY: Final = FOLDER / "_kernel.so"

_MEASURE: Final = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.POINTER(ctypes.c_double), ctypes.POINTER(ctypes.c_double)
)

# Functions that keep the GIL: to release it takes longer than they do.
_LOAD: Final = ctypes.PYFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)
_STORE: Final = ctypes.PYFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64)
_SWAP: Final = ctypes.PYFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)

_TYPES: Final = {"int": ctypes.c_int64, "real": ctypes.c_double}
_ELEMENTS: Final = {"ints": np.dtype(np.int64), "reals": np.dtype(np.float64)}


def sources_hash() -> str:
    """Return the hash of the C++ sources beside this file, and of the compiler's flags."""
    digest = hashlib.sha256()
    for path in sorted([*FOLDER.glob("*.?pp"), FOLDER / "flags.txt"]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


@cache
def library() -> ctypes.CDLL:
    """Load the compiled library.

    Raises:
        KernelError: It is missing, cannot be loaded here, or was compiled from other sources.
    """
    again = "Compile it: python packages/ur-core/hatch_build.py in a checkout, or install the package again"
    if not LIBRARY.exists():
        raise KernelError(f"the compiled kernel {LIBRARY.name} is missing in {FOLDER}. {again}")
    try:
        loaded = ctypes.CDLL(str(LIBRARY))
    except OSError as error:
        raise KernelError(f"the compiled kernel is not for this machine: {error}. {again}") from None
    if not _is_of_these_sources(loaded):
        raise KernelError(f"the compiled kernel is not that of the sources beside it, in {FOLDER}. {again}")
    return loaded


def _is_of_these_sources(loaded: ctypes.CDLL) -> bool:
    try:
        describe = loaded.kernel_sources
    except AttributeError:
        return False
    describe.restype = ctypes.c_char_p
    return bool(describe().decode() == sources_hash())


@cache
def function(name: str, arguments: int) -> Callable[..., None]:
    """Return a function of the library; its arguments are addresses and 64-bit integers."""
    found = getattr(library(), name)
    found.restype, found.argtypes = None, [ctypes.c_int64] * arguments
    result: Callable[..., None] = found
    return result


_LEAST_ROWS: Final = 16  # per thread from which on another one is worth waking


def _address(name: str) -> int:
    """Return the address of a function of the library."""
    return int(ctypes.cast(getattr(library(), name), ctypes.c_void_p).value or 0)


class RowLoop:
    """Calls a function of the kernel for n rows, on several threads where there are many.

    Args:
        name: Function of the library; it takes a structure, a first row and the one after the last.
        struct: The structure.
        n: Number of rows.
        threads: Threads to compute on. Results do not depend on their number.
    """

    def __init__(self, name: str, struct: Struct, n: int, threads: int) -> None:
        self._made_of = name, struct, n, threads
        threads = min(threads, n // _LEAST_ROWS)
        self._call, self._arguments = function(name, 3), [struct.address, 0, n]
        if threads > 1:
            self._call, self._arguments = function("share_rows", 4), [_address(name), struct.address, n, threads]

    def __call__(self) -> None:
        """Call the function for all rows."""
        self._call(*self._arguments)

    def __reduce__(self) -> tuple[Any, ...]:
        return RowLoop, self._made_of


@cache
def _layout(name: str) -> tuple[type[ctypes.Structure], tuple[tuple[str, str, tuple[str, ...]], ...]]:
    describe = getattr(library(), f"{name}_fields")
    describe.restype = ctypes.c_char_p
    fields = []
    for line in describe().decode().splitlines():
        kind, field, *size = line.split(maxsplit=2)
        fields.append((kind, field, tuple(size[0].replace("*", " ").split()) if size else ()))
    members = [(field, _TYPES.get(kind, ctypes.c_void_p)) for kind, field, _ in fields]
    return type(name, (ctypes.Structure,), {"_fields_": members}), tuple(fields)


class Struct:
    """One of the kernel's structures, with the arrays that it points to.

    Arrays are shared: the kernel reads and writes the caller's own. They must never be replaced, only written to; a
    test holds that for this package. A pickled structure is built anew with its arrays, which stay shared with other
    parts of the same pickle.

    Args:
        name: Name of the structure.
        values: All of its fields: numbers; C-contiguous float64 or int64 arrays of the right size; structures; for a
            function its name in the library, or a callable `(q_rad, spare_m)` that fills the second array.

    Raises:
        KernelError: A field is missing, unknown, or of another type or size.
    """

    def __init__(self, name: str, **values: Any) -> None:
        kind_of, fields = _layout(name)
        names = [field for _, field, _ in fields]
        if set(names) != set(values):
            wrong = sorted(set(names) ^ set(values))
            raise KernelError(f"{name} has the fields {', '.join(names)}: these are missing or unknown: {wrong}")
        self.name, self.values = name, values
        self._kept: list[Any] = []
        self._raised: list[BaseException] = []
        self._struct = kind_of(**{field: self._member(kind, field, size) for kind, field, size in fields})
        self.address: Final[int] = ctypes.addressof(self._struct)
        """Address for the kernel's functions; valid as long as this object lives."""

    def _member(self, kind: str, field: str, size: tuple[str, ...]) -> Any:
        value = self.values[field]
        if kind in _TYPES:
            return value
        if kind == "link":
            if value is not None and size[0] not in (value.name, "void"):
                raise KernelError(f"{self.name}.{field} must be a {size[0]}, found a {value.name}")
            return None if value is None else value.address
        if kind == "function":
            return self._function(value)
        count = prod(int(each) if each.isdigit() else int(self.values[each]) for each in size)
        if not (
            isinstance(value, np.ndarray)
            and value.dtype == _ELEMENTS[kind]
            and value.flags.c_contiguous
            and value.flags.aligned
        ):
            raise KernelError(f"{self.name}.{field} must be a contiguous array of {_ELEMENTS[kind]}, found {value!r}")
        if value.size != count:
            raise KernelError(f"{self.name}.{field} must have {' x '.join(size)} = {count} values, found {value.size}")
        return value.ctypes.data

    def _function(self, value: str | Callable[[Array, Array], None]) -> int | None:
        if isinstance(value, str):
            return _address(value)
        pairs, function = int(self.values["pairs"]), value

        def measure(context: object, q_rad: Any, spare_m: Any) -> None:
            try:
                function(np.ctypeslib.as_array(q_rad, (12,)), np.ctypeslib.as_array(spare_m, (pairs,)))
            except BaseException as error:  # the kernel cannot raise it
                self._raised.append(error)

        callback = _MEASURE(measure)
        self._kept.append(callback)
        return ctypes.cast(callback, ctypes.c_void_p).value

    def check(self) -> None:
        """Raise what a callable of this structure raised during the last call of the kernel."""
        if self._raised:
            error, self._raised = self._raised[0], []
            raise error

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (self.name, self.values)


def _rebuilt(name: str, values: dict[str, Any]) -> Struct:
    return Struct(name, **values)


class Counters:
    """Counters in memory that processes share. Who reads a value sees all that its writer wrote before.

    Args:
        values: (n,) int64, contiguous.
    """

    def __init__(self, values: NDArray[np.int64]) -> None:
        library()  # with its checks
        self._values = values  # keeps the memory
        self._addresses = [values.ctypes.data + values.itemsize * number for number in range(values.size)]
        self._load: Callable[[int], int] = _LOAD(_address("counter_load"))
        self._store: Callable[[int, int], None] = _STORE(_address("counter_store"))
        self._swap = _SWAP(_address("counter_swap"))

    def __getitem__(self, number: int) -> int:
        return self._load(self._addresses[number])

    def __setitem__(self, number: int, value: int) -> None:
        self._store(self._addresses[number], value)

    def swap(self, number: int, found: int, value: int) -> bool:
        """Write a value where another one is found, in one step; return False if it is not."""
        return bool(self._swap(self._addresses[number], found, value))


class Constants:
    """Coefficients of a function of the kernel, with their address.

    Args:
        values: Numbers; copied.
    """

    def __init__(self, values: Array) -> None:
        self._values: Array = np.array(values, dtype=np.float64, order="C")
        self.size: Final = self._values.size
        self.address: Final[int] = int(self._values.ctypes.data)

    def __reduce__(self) -> tuple[Any, ...]:
        return Constants, (self._values,)


@cache
def _sizes(name: str, count: int) -> tuple[tuple[int, int, tuple[tuple[int, str], ...]], ...]:
    """Return position, constant factor, and positions and fields of further factors, of each array of a function."""
    describe = getattr(library(), f"{name}_sizes")
    describe.restype = ctypes.c_char_p
    texts, arrays = describe().decode().split(), []
    if len(texts) != count:
        raise KernelError(f"{name} takes {len(texts)} arguments, found {count}")
    for at, text in enumerate(texts):
        if text != "-":
            numbers = [int(each) for each in text.split("*") if each.isdigit()]
            others = [each[1:].partition(".") for each in text.split("*") if not each.isdigit()]
            arrays.append((at, prod(numbers), tuple((int(other), field) for other, _, field in others)))
    return tuple(arrays)


def call(name: str, *arguments: Array | Struct | Constants | int) -> None:
    """Call a function of the library. Its arguments live as long as the call.

    Looking up an array's address takes longer than most of the kernel's work: give few of them.

    Raises:
        KernelError: An array is not a C-contiguous one of float64, or has another size than the function takes.
    """
    addresses = [*map(_number, arguments)]
    for at, size, factors in _sizes(name, len(arguments)):
        for other, field in factors:
            size *= addresses[other] if not field else _field(arguments[other], field)
        found = getattr(arguments[at], "size", None)
        if found != size:
            raise KernelError(f"argument {at} of {name} must have {size} values, found {found}")
    function(name, len(arguments))(*addresses)


def _field(struct: Array | Struct | Constants | int, name: str) -> int:
    if not isinstance(struct, Struct):
        raise KernelError(f"a structure with the field {name} is needed, found {struct!r:.50}")
    return int(struct.values[name])


def _number(argument: Array | Struct | Constants | int) -> int:
    if isinstance(argument, int):
        return argument
    if isinstance(argument, Struct | Constants):
        return argument.address
    if argument.dtype != np.float64 or not argument.flags.c_contiguous:
        raise KernelError(f"the kernel takes contiguous float64 arrays, found {argument.dtype}, {argument.strides}")
    return int(argument.ctypes.data)
