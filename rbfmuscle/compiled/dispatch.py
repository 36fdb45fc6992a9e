"""The compiled function of numba's that `compiled` makes: fewer versions of each, compiled with less ado."""

from __future__ import annotations

import gc
import threading
from typing import Any

from numba.core import types
from numba.core.registry import CPUDispatcher

from rbfmuscle.compiled.cache import LoopCache


class Loop(CPUDispatcher):
    """A compiled loop, kept on disk by content.

    A number written out in a call is an argument like any other: numba would compile the callee once for each of
    them. While numba builds its graphs of objects, none of which is garbage, no garbage is looked for; that took a
    quarter of the time.
    """

    def __init__(self, py_func: Any, locals: Any = None, targetoptions: Any = None, **more: Any) -> None:
        super().__init__(py_func, locals=locals or {}, targetoptions=targetoptions or {}, **more)
        self._cache = LoopCache(self)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Numba's, for the types of the arguments without their values."""
        plain = tuple(types.unliteral(kind) for kind in args)
        return super().get_call_template(plain, {name: types.unliteral(kind) for name, kind in kws.items()})

    def entry_name(self, arguments: tuple) -> str:
        """Name of the entry in the cache for a tuple of numba types."""
        self.targetctx.refresh()
        return self._cache.entry_name(arguments, self.targetctx.codegen())

    def compile(self, sig: Any) -> Any:
        """Numba's, with the garbage collector held back; whatever ends it, no lock is left behind."""
        with _NO_COLLECTION:
            try:
                return super().compile(sig)
            finally:
                self._cache.let_go_all()


class _NoCollection:
    """Holds back the garbage collector while any thread is inside."""

    def __init__(self) -> None:
        self.lock, self.inside, self.was_on = threading.Lock(), 0, False

    def __enter__(self) -> None:
        with self.lock:
            if self.inside == 0:
                self.was_on = gc.isenabled()
                gc.disable()
            self.inside += 1

    def __exit__(self, *error: Any) -> None:
        with self.lock:
            self.inside -= 1
            if self.inside == 0 and self.was_on:
                gc.enable()


_NO_COLLECTION = _NoCollection()
