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
from functools import cache, partial
from pathlib import Path

import numba
import platformdirs
from llvmlite.binding import ModuleRef, ValueRef, parse_assembly, parse_bitcode
from numba.core import types
from numba.core.caching import FunctionCache
from numba.core.codegen import Codegen
from numba.core.compiler import CompileResult
from numba.core.cpu import CPUContext
from numba.core.dispatcher import Dispatcher
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.typing import Signature

from rbfmuscle.compiling import LoopCompiler

# Instructions of a loop, less its arguments, from which on callers refer to its code.
LARGE = 100
_IMPORT = re.compile(r"^(?:from\s+([\w.]+)\s+)?import\s+(\([^)]*\)|.*)", re.MULTILINE)


def compiled(function: Callable | None = None, **options: object) -> Callable:
    """Declare a loop: compiled or loaded at its first call; the function itself where
    ``NUMBA_DISABLE_JIT`` is set.

    It takes arrays, numbers and NamedTuples of these; options are those of ``numba.njit``.
    ``nogil=False`` suits short loops that are called often, because releasing the interpreter's
    lock takes longer than they do.
    """
    if function is None:
        return lambda inner: compiled(inner, **options)
    if numba.config.DISABLE_JIT:
        return function
    return _declared(function, False, options)


def _declared(function: Callable, is_inner: bool, options: dict[str, object]) -> Dispatcher:
    # No loop is an argument of another: the wrapper for that is left out.
    settings = {
        "pipeline_class": LoopCompiler,
        "error_model": "numpy",
        "nogil": True,
        "no_cfunc_wrapper": True,
        "no_cpython_wrapper": is_inner,
        "_nrt": True,
        **options,
    }
    loop = numba.njit(**settings)(function)
    loop._compiler.compile = _no_collection()(loop._compiler.compile)
    loop._cache = _LoopCache(function, is_inner)
    if is_inner:
        loop._compiler.compile = _kept_apart(loop._compiler.compile)
        return loop
    # Other loops call a form of its own: what Python calls a loop by takes longer to compile than
    # many a loop where arguments hold dozens of arrays.
    inner = cache(partial(_declared, function, True, options))
    loop.get_call_template = lambda args, kws: inner().get_call_template(*_plain(args, kws))
    loop.get_overload = lambda signature: inner().get_overload(signature)
    return loop


def _plain(args, kws):
    """Types of arguments without constants: numba would compile a loop for each ``True``, ``False``
    and 0 that another loop gives it.
    """
    plain = {name: types.unliteral(kind) for name, kind in kws.items()}
    return [types.unliteral(kind) for kind in args], plain


# Loops whose code is not copied into that of their callers: by symbol, the entry of the cache that
# holds them, empty where none does.
_apart: dict[str, str] = {}
# Loops of the cache that this process has loaded, by the name of the entry.
_loaded: dict[str, CompileResult] = {}


def _kept_apart(compile_loop: Callable) -> Callable:
    """Callers of a large loop refer to its machine code. Numba would optimise and translate a copy
    for each caller and each caller of that; only small loops gain by it.
    """

    def compile_apart(args, return_type):
        result = compile_loop(args, return_type)
        library, symbol = result.library, result.fndesc.llvm_func_name
        if _is_large(library._final_module.get_function(symbol)):
            empty = parse_bitcode(_empty_bitcode(library.codegen))
            library._get_module_for_linking = lambda: empty
            _apart[symbol] = ""
        return result

    return compile_apart


def _is_large(function: ValueRef) -> bool:
    """Whether a loop has more instructions than a caller would take in."""
    count = -len(list(function.arguments))
    for block in function.blocks:
        count += sum(1 for _ in block.instructions)
        if count > LARGE:
            return True
    return False


def loops_path() -> Path:
    """Folder of compiled loops: ``RBFMUSCLE_LOOPS``, or in the user's cache folder of the
    platform.
    """
    place = os.environ.get("RBFMUSCLE_LOOPS")
    return Path(place or platformdirs.user_cache_path("rbfmuscle", appauthor=False) / "loops")


class _LoopCache(FunctionCache):
    """Numba's cache of one function, with other files."""

    def __init__(self, function: Callable, is_inner: bool) -> None:
        # Read when the module is imported: the file may be edited before the loop is called.
        digest = None if function.__closure__ else _sources_digest(function.__module__)
        self._py_func, self._cache_path = function, f"{function.__module__}-{digest}"
        self._enabled = digest is not None
        self._is_inner = is_inner

    def _entry(self, signature: Signature | tuple, codegen: Codegen) -> str:
        """Name of a loop's file in the folder of loops."""
        code = self._py_func.__code__
        types = [_spelled(kind) for kind in getattr(signature, "args", signature)]
        facts = (
            types,
            codegen.magic_tuple(),
            code.co_firstlineno,
            code.co_code,
            self._is_inner,
            numba.config.BOUNDSCHECK,
        )
        name = f"{self._py_func.__qualname__}-{_digest(repr(facts).encode())}".replace(
            "<locals>", "local"
        )
        return f"{self._cache_path}/{name}"

    def load_overload(self, sig, target_context):
        # Numba would read all that it compiles by before it loads a loop: 0.25 s.
        rtsys.initialize(target_context)
        return self._load_overload(sig, target_context)

    def _load_overload(self, sig, target_context):
        if self._enabled:
            result = _load(self._entry(sig, target_context.codegen()), target_context)
            if result is not None:
                return result
        _say("compiling loops for this processor, once; a first run takes a minute or two longer")
        return None

    def _save_overload(self, sig, data):
        if not self._enabled or data.lifted or data.library.has_dynamic_globals:
            return
        module = data.library._final_module
        values = (*module.functions, *module.global_variables)
        symbols = [value.name for value in values if not value.is_declaration]
        needs = [
            (_apart[one.name], one.name)
            for one in module.functions
            if one.is_declaration and one.name in _apart
        ]
        if not all(entry for entry, _ in needs):
            return
        entry = self._entry(sig, data.codegen)
        if _store(loops_path() / entry, dumps((needs, symbols, data._reduce()))):
            symbol = data.fndesc.llvm_func_name
            _apart.update({symbol: entry} if symbol in _apart else {})


def _store(path: Path, content: bytes) -> bool:
    """Write an entry, whole or not at all, whoever else writes it; whether it could be written."""
    part = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(_digest(content).encode() + b"\n" + content)
        part.replace(path)
    except OSError as error:
        _say(
            f"cannot keep compiled loops in {loops_path()} ({error.strerror}); every process "
            "compiles them"
        )
        return False
    return True


def _load(entry: str, target_context: CPUContext) -> CompileResult | None:
    """A loop from its entry with those that it calls, None where one of them is not there."""
    if entry in _loaded:
        return _loaded[entry]
    path = loops_path() / entry
    with contextlib.suppress(OSError, ValueError):
        head, content = path.read_bytes().split(b"\n", 1)
        if head == _digest(content).encode():  # whole
            needs, symbols, parts = pickle.loads(content)
            for other, symbol in needs:
                result = _load(other, target_context)
                if result is None or result.fndesc.llvm_func_name != symbol:
                    return None
            _note_use(path.parent)
            result = _loaded[entry] = _rebuilt(target_context, symbols, parts)
            _apart[result.fndesc.llvm_func_name] = entry
            return result
    return None


def _rebuilt(target_context, symbols, parts):
    """A loop from what was kept of it. Its bitcode, which only a caller that is compiled needs, is
    read then: that is half the time of loading.
    """
    (name, kind, (machine_code, bitcode)), *rest = parts
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
