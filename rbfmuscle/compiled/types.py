"""Types of a loop's arguments as text that a JSON file can hold, and back."""

import importlib
from typing import Any


def spell_type(kind: Any) -> Any:
    """A numba type as text, or as a list for tuples: ``"f8[:,::1]"``-like names of arrays, numbers by name.

    Raises
    ------
    ValueError
        For a type that has no spelling here.
    """
    from numba.core import types

    if isinstance(kind, types.Array):
        flags = ("" if kind.mutable else " readonly") + ("" if kind.aligned else " unaligned")
        return f"{kind.dtype} {kind.ndim}{kind.layout}{flags}"
    if isinstance(kind, types.BaseNamedTuple):
        home = kind.instance_class
        return [f"{home.__module__}:{home.__qualname__}", *map(spell_type, kind.types)]
    if isinstance(kind, types.BaseTuple):
        return ["tuple", *map(spell_type, kind.types)]
    if isinstance(kind, types.Omitted) and isinstance(kind.value, bool | int | float | type(None)):
        return ["omitted", kind.value]
    if isinstance(kind, types.Number | types.Boolean | types.NoneType) and not isinstance(
        kind, types.Literal
    ):
        return str(kind)
    raise ValueError(f"a loop has an argument of type {kind}, which cannot be foretold")


def read_type(text: Any) -> Any:
    """The numba type of a spelling.

    Raises
    ------
    AttributeError, ImportError, ValueError
        If it names what does not exist.
    """
    from numba.core import types

    if isinstance(text, str):
        name, _, shape = text.partition(" ")
        kind = types.none if name == "none" else getattr(types, "boolean" if name == "bool" else name)
        if not shape:
            return kind
        place, *flags = shape.split()
        return types.Array(
            kind, int(place[:-1]), place[-1], readonly="readonly" in flags, aligned="unaligned" not in flags
        )
    head, *parts = text
    if head == "omitted":
        return types.Omitted(parts[0])
    inner = [read_type(part) for part in parts]
    if head == "tuple":
        return types.Tuple(inner)
    module, _, name = head.partition(":")
    home = getattr(importlib.import_module(module), name)
    uniform = inner and all(kind == inner[0] for kind in inner)
    return types.NamedUniTuple(inner[0], len(inner), home) if uniform else types.NamedTuple(inner, home)
