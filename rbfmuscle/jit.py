"""Declaration of compiled loops, and the cache of their code.

Each module that declares loops has a folder named by a digest of its source and of the sources that
it imports. Numba's own cache misses edits of functions that are inlined from other files, and is
unsafe for concurrent processes.
"""

import contextlib
import gc
import hashlib
import os
import pickle
import re
import shutil
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numba
import platformdirs
from llvmlite.binding import ModuleRef, parse_assembly, parse_bitcode
from numba.core.caching import FunctionCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

_IMPORT = re.compile(r"^(?:from\s+([\w.]+)\s+)?import\s+(\([^)]*\)|.*)", re.MULTILINE)


def compiled(function: Callable | None = None, **options: object) -> Callable:
    """Declare a loop: compiled or loaded at its first call; the function itself where
    ``NUMBA_DISABLE_JIT`` is set.

    It takes arrays, numbers and NamedTuples of these; options are those of ``numba.njit``.
    ``nogil=False`` suits short loops that are called often, because releasing the interpreter's
    lock takes longer than they do. ``_nrt=False`` suits inner loops that are called for each point,
    make no array and return none: references to arrays are then not counted.
    """
    if function is None:
        return lambda inner: compiled(inner, **options)
    if numba.config.DISABLE_JIT:
        return function
    # No loop is an argument of another: the wrapper for that, an eighth of the time of compiling,
    # is left out.
    loop = numba.njit(**{"nogil": True, "no_cfunc_wrapper": True, "_nrt": True, **options})(
        function
    )
    loop._compiler.compile = _no_collection()(loop._compiler.compile)
    loop.get_call_template = _of_plain_types(loop.get_call_template)
    loop._cache = _LoopCache(function)
    return loop


def _of_plain_types(find: Callable) -> Callable:
    """A loop that is called with constants is compiled once for all of them: numba would compile
    it for each ``True``, ``False`` and 0 that another loop gives it.
    """

    def find_plain(args, kws):
        return find(
            [numba.types.unliteral(kind) for kind in args],
            {name: numba.types.unliteral(kind) for name, kind in kws.items()},
        )

    return find_plain


def inner(**options: object) -> Callable:
    """Declare a loop that only other loops call: what Python would call it by is not compiled,
    which takes longer than many a loop where arguments hold dozens of arrays.
    """
    return compiled(None, no_cpython_wrapper=True, **options)


def loops_path() -> Path:
    """Folder of compiled loops: ``RBFMUSCLE_LOOPS``, or in the user's cache folder of the
    platform.
    """
    place = os.environ.get("RBFMUSCLE_LOOPS")
    return Path(place or platformdirs.user_cache_path("rbfmuscle", appauthor=False) / "loops")


class _LoopCache(FunctionCache):
    """Numba's cache of one function, with other files."""

    def __init__(self, function: Callable) -> None:
        # Read when the module is imported: the file may be edited before the loop is called.
        digest = None if function.__closure__ else _sources_digest(function.__module__)
        self._py_func, self._cache_path = function, f"{function.__module__}-{digest}"
        self._enabled = digest is not None

    def _path(self, signature, codegen):
        code = self._py_func.__code__
        types = [_spelled(kind) for kind in getattr(signature, "args", signature)]
        facts = (
            types,
            codegen.magic_tuple(),
            code.co_firstlineno,
            code.co_code,
            numba.config.BOUNDSCHECK,
        )
        name = f"{self._py_func.__qualname__}-{_digest(repr(facts).encode())}".replace(
            "<locals>", "local"
        )
        return loops_path() / self._cache_path / name

    def _load_overload(self, sig, target_context):
        path = self._path(sig, target_context.codegen())
        with contextlib.suppress(OSError, ValueError):
            head, content = path.read_bytes().split(b"\n", 1)
            if self._enabled and head == _digest(content).encode():  # whole
                _note_use(path.parent)
                return _rebuilt(target_context, pickle.loads(content))
        _say("compiling loops for this processor, once; a first run takes a minute or two longer")
        return None

    def _save_overload(self, sig, data):
        if not self._enabled or data.lifted or data.library.has_dynamic_globals:
            return
        module = data.library._get_module_for_linking()
        values = (*module.functions, *module.global_variables)
        symbols = [value.name for value in values if not value.is_declaration]
        path, content = self._path(sig, data.codegen), dumps((symbols, data._reduce()))
        part = path.with_name(f"{path.name}.{os.getpid()}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            part.write_bytes(_digest(content).encode() + b"\n" + content)
            part.replace(path)  # whole or absent, whoever else writes it
        except OSError as error:
            _say(
                f"cannot keep compiled loops in {loops_path()} ({error.strerror}); every process "
                "compiles them"
            )


def _rebuilt(target_context, parts):
    """A loop from what was kept of it. Its bitcode, which only a caller that is compiled needs, is
    read then: that is half the time of loading.
    """
    symbols, ((name, kind, (machine_code, bitcode)), *rest) = parts
    codegen = target_context.codegen()
    codegen._engine._defined_symbols.update(symbols)
    result = CompileResult._rebuild(
        target_context, (name, kind, (machine_code, _empty_bitcode(codegen))), *rest
    )
    library = result.library
    library._shared_module = None

    def read() -> ModuleRef:
        if library._shared_module is None:
            library._shared_module = parse_bitcode(bitcode)
        return library._shared_module

    library._get_module_for_linking = read
    return result


@cache
def _empty_bitcode(codegen):
    return parse_assembly(str(codegen._create_empty_module("empty"))).as_bitcode()


def _spelled(kind):
    """A numba type as text; a NamedTuple with its class and fields."""
    home = getattr(kind, "instance_class", None)
    named = home and (home.__module__, home.__qualname__, home._fields)
    return repr(kind), named, [_spelled(part) for part in getattr(kind, "types", ())]


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:24]


@cache
def _sources_digest(name: str) -> str | None:
    """Digest of a module, of what it imports of its package and of this one; None where a source
    cannot be read.
    """
    ours = {name.partition(".")[0], "rbfmuscle"}
    sources = {}
    left = [name]
    while left:
        one = left.pop()
        if one not in sources and one in sys.modules and one.partition(".")[0] in ours:
            sources[one], imported = _source(one)
            left += imported
    facts = (sys.version, numba.__version__, sorted(sources.items()))
    return _digest(repr(facts).encode()) if all(sources.values()) else None


@cache
def _source(name: str) -> tuple[str, list[str]]:
    """Digest of a module's file, empty where there is none, and names imported at its top that may
    be modules.
    """
    try:
        content = Path(sys.modules[name].__file__ or "").read_bytes()
    except (OSError, AttributeError):
        return "", []
    imported = []
    for origin, names in _IMPORT.findall(content.decode(errors="replace")):
        members = re.findall(r"[\w.]+", names)
        imported += [origin, *(f"{origin}.{member}" for member in members)] if origin else members
    return _digest(content), imported


@cache
def _note_use(folder: Path) -> None:
    """Once per process; at the first use of a day, folders unused for 60 days are removed."""
    with contextlib.suppress(OSError):  # it may only be read, or another process removes it
        if time.time() - folder.stat().st_mtime > 86400:
            os.utime(folder)
            for other in folder.parent.glob("*-" + 24 * "[0-9a-f]"):
                if time.time() - other.stat().st_mtime > 60 * 86400:
                    shutil.rmtree(other, ignore_errors=True)


@contextlib.contextmanager
def _no_collection():
    """Switch the garbage collector off, which takes a seventh of the time of compiling."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


@cache
def _say(text: str) -> None:
    print(f"rbfmuscle: {text}", file=sys.stderr, flush=True)
