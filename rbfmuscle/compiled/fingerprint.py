"""What a compiled loop depends on, as one digest: its text, the loops it calls, the constants it reads.

Numba names a cached loop by the text of its own file: a caller in another file keeps the old code of a loop
that was edited inside it. Here the names that a loop's bytecode mentions are looked up and followed: loops by
their own bytecode and so on, constants and named tuples by value. Files, lines, comments and docstrings play no
part, so checkouts share what they have in common, and an edit costs the loops that it reaches.
"""

from __future__ import annotations

import enum
import hashlib
import importlib.util
import types
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

_PLAIN = (bool, int, float, complex, str, bytes, type(None), type(Ellipsis), np.generic, np.dtype, slice)


def loop_digest(loop: Callable) -> str:
    """Digest of a loop and of everything of ours that its compiled code depends on.

    Raises
    ------
    TypeError
        If the loop reads a global whose value cannot be told apart from another's.
    """
    digest = hashlib.sha256()
    _Reader(digest.update).loop(loop)
    return digest.hexdigest()


@cache
def machine_digest(codegen: Any) -> str:
    """Digest of what else shapes compiled code: Python, numba, LLVM, numpy, the processor, numba's settings.

    Parameters
    ----------
    codegen : numba.core.codegen.Codegen
        Of the target that is compiled for.
    """
    import llvmlite
    import numba
    from numba.core import config

    settings = [
        getattr(config, name, None)
        for name in (
            "OPT",
            "LOOP_VECTORIZE",
            "SLP_VECTORIZE",
            "BOUNDSCHECK",
            "ENABLE_AVX",
            "DEBUGINFO_DEFAULT",
        )
    ]
    versions = (importlib.util.MAGIC_NUMBER, numba.__version__, llvmlite.__version__, np.__version__)
    return hashlib.sha256(repr((versions, codegen.magic_tuple(), settings)).encode()).hexdigest()


class _Reader:
    """Feeds a digest with values and code; what was met once is named by its place, which ends recursion."""

    def __init__(self, feed: Callable[..., Any]) -> None:
        self.feed = feed
        self.met = {}

    def text(self, *parts: Any) -> None:
        self.feed(repr(parts).encode())

    def loop(self, loop: Any) -> None:
        """A dispatcher of numba: its options and its function."""
        if self._again(loop):
            return
        self.text("loop", loop.py_func.__module__, loop.py_func.__qualname__)
        self.value(dict(loop.targetoptions))
        self.function(loop.py_func)

    def function(self, function: Callable[..., Any]) -> None:
        code = function.__code__
        self.code(code, function.__doc__)
        self.value(function.__defaults__)
        self.value([cell.cell_contents for cell in function.__closure__ or ()])
        names = sorted(_names(code))
        for name in names:
            if name in function.__globals__:
                self.text("name", name)
                self.member(function.__globals__[name], names)

    def member(self, value: Any, names: list[str]) -> None:
        """A global; of a module, the loops and constants that are read of it."""
        if not isinstance(value, types.ModuleType):
            self.value(value)
            return
        for name in names:
            part = vars(value).get(name)
            if _is_loop(part) or isinstance(part, (*_PLAIN, tuple, np.ndarray)):
                self.text("of", value.__name__, name)
                self.value(part)

    def code(self, code: Any, doc: str | None = None) -> None:
        constants = code.co_consts
        if doc is not None and constants and constants[0] == doc:
            constants = constants[1:]
        self.text(code.co_code, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
        self.text(code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags)
        self.text(getattr(code, "co_exceptiontable", b""))
        self.value(constants)

    def value(self, value: Any) -> None:
        if isinstance(value, enum.Enum):
            self.text("enum", type(value).__qualname__, value.name, value.value)
        elif isinstance(value, _PLAIN):
            self.text(type(value).__name__, value)
        elif isinstance(value, np.ndarray):
            self.text("array", value.dtype.str, value.shape)
            self.feed(np.ascontiguousarray(value).tobytes())
        elif isinstance(value, tuple | list):
            self.text(type(value).__name__, len(value))
            for item in value:
                self.value(item)
        elif isinstance(value, set | frozenset):
            self.text("set", sorted(map(repr, value)))
        elif isinstance(value, dict):
            for key in sorted(value, key=repr):
                self.text("key", key)
                self.value(value[key])
        else:
            self.object(value)

    def object(self, value: Any) -> None:
        """Loops, code, classes, functions and modules."""
        if _is_loop(value):
            self.loop(value)
        elif isinstance(value, types.CodeType):
            self.code(value)
        elif isinstance(value, type):
            self.kind(value)
        elif isinstance(value, types.ModuleType):
            self.text("module", value.__name__)
        elif callable(value):
            name = getattr(value, "__qualname__", getattr(value, "__name__", None))
            self.text("callable", getattr(value, "__module__", None), name or type(value).__qualname__)
        elif (type(value).__module__ or "").startswith("numba."):
            self.text("numba", repr(value))
        else:
            raise TypeError(
                f"a loop reads a global of type {type(value).__qualname__}, which has no digest: {value!r}"
            )

    def kind(self, kind: Any) -> None:
        self.text("class", kind.__module__, kind.__qualname__, getattr(kind, "_fields", None))
        if issubclass(kind, enum.Enum):
            self.text([(member.name, member.value) for member in kind])
        self.value(getattr(kind, "_field_defaults", None))

    def _again(self, value):
        place = self.met.setdefault(id(value), len(self.met))
        self.text("place", place)
        return place != len(self.met) - 1


def _is_loop(value):
    from numba.core.dispatcher import Dispatcher

    return isinstance(value, Dispatcher)


def _names(code):
    """Names that a code object and those inside it mention."""
    found = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            found |= _names(constant)
    return found
