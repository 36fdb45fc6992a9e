"""Numba's compiler, without work that loops do not need."""

from llvmlite.binding.ffi import lib as llvm
from numba.core import ir, types
from numba.core.compiler import Compiler, StateDict
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.targetconfig import TargetConfig
from numba.core.typed_passes import NativeLowering
from numba.core.types.containers import BaseTuple
from numba.core.types.misc import SliceType
from numba.extending import overload
from numba.np import arrayobj

_PLAIN = (ir.Assign, ir.Del, ir.Jump, ir.Branch, ir.Return, ir.Raise, ir.StaticRaise)
# Expressions that hand on arrays of their operands and make none.
_HANDING_ON = {
    "getattr",
    "static_getitem",
    "cast",
    "phi",
    "null",
    "build_tuple",
    "exhaust_iter",
    "pair_first",
    "pair_second",
    "iternext",
}


class LoopCompiler(Compiler):
    """Numba's compiler, with `_Lowering`."""

    def define_pipelines(self) -> list[PassManager]:
        """The passes of numba, with another one for lowering."""
        (passes,) = super().define_pipelines()
        passes.passes = [
            (_Lowering, text) if kind is NativeLowering else (kind, text)
            for kind, text in passes.passes
        ]
        passes._finalized = False
        passes.finalize()
        return [passes]


@register_pass(mutates_CFG=True, analysis_only=False)
class _Lowering(NativeLowering):
    """Lowering that counts no references to arrays in a loop that makes none and returns none: all
    are its caller's. Counting is half the code of loops whose arguments hold dozens of arrays.
    """

    _name = "lowering_without_references"

    def run_pass(self, state: StateDict) -> bool:
        if state.flags.no_cpython_wrapper and not _makes_arrays(state):
            state.targetctx = state.targetctx.subtarget(enable_nrt=False)
            state.targetctx.__dict__.pop("nrt", None)
        return super().run_pass(state)


def _makes_arrays(state: StateDict) -> bool:
    """Whether a loop makes arrays or returns some."""
    models = state.targetctx.data_model_manager

    def holds(kind):
        return models[kind].contains_nrt_meminfo()

    if holds(state.return_type):
        return True
    for block in state.func_ir.blocks.values():
        for step in block.body:
            if isinstance(step, (ir.SetItem, ir.StaticSetItem)):
                if holds(state.typemap[step.value.name]):
                    return True
            elif isinstance(step, ir.Assign) and isinstance(step.value, ir.Expr):
                if holds(state.typemap[step.target.name]) and not _hands_on(state, step.value):
                    return True
            elif not isinstance(step, _PLAIN):
                return True
    return False


def _hands_on(state: StateDict, expression: ir.Expr) -> bool:
    if expression.op == "call":  # of a NamedTuple
        return isinstance(state.typemap[expression.func.name], types.NamedTupleClass)
    if expression.op == "getitem":  # a part of an array, but no choice of its elements
        index = state.typemap[expression.index.name]
        kinds = index.types if isinstance(index, BaseTuple) else (index,)
        return all(isinstance(kind, (types.Integer, SliceType)) for kind in kinds)
    return expression.op in _HANDING_ON


def _hasten_compiling() -> None:
    """Leave out what numba does at each of a million steps: it times the calls of LLVM, and
    compares its options one by one where it looks for what is compiled already. An assignment of
    another shape raises a constant text: numba compiles formatting for it.
    """
    llvm._lock._cblist.clear()
    arrayobj.raise_with_shape_context = _raise_other_shape
    TargetConfig.__hash__ = lambda self: hash(type(self))
    TargetConfig.__eq__ = _equal_options


def _raise_other_shape(source, target):
    """What a loop calls where it assigns an array of another shape."""


@overload(_raise_other_shape)
def _raise_other_shape_loop(source, target):
    def raise_error(source, target):
        raise ValueError("an array is assigned to a part of another shape")

    return raise_error


def _equal_options(some, other):
    if some is other or some._values == getattr(other, "_values", None):
        return True
    return type(some) is type(other) and some.values() == other.values()


_hasten_compiling()
