"""The part of Python that steps are written in, and the library that is made of them.

    class Filter(Record):
        n: int
        share: float
        value: Floats
        reading: Floats

    @step
    def smooth(f: Filter) -> int:
        for i in range(f.n):
            f.value[i] += f.share * (f.reading[i] - f.value[i])
        return 0

Numbers are ``int`` (64 bits) and ``float`` (double); arrays are one-dimensional, contiguous and made by numpy. There are
assignments, ``if``, ``while``, ``for`` over a ``range``, arithmetic, comparisons, the functions of ``system`` and calls of
other steps. A variable keeps the kind of its first value. A division by zero raises in Python and is not a number in C:
steps do not divide by what may be zero.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

MODULES: tuple[str, ...] = (
    "sioms.native.system",
    "sioms.motion.axis_step",
    "sioms.plant.friction_step",
    "sioms.plant.motor_step",
)
"""Modules whose records and steps are compiled, each after those that it uses."""
PREFIX = "sioms_"
"""Of all names in the library: those of the C library are not ours."""
LIBRARY = Path(__file__).with_name("_steps.so")
UNCOMPILED = "SIOMS_UNCOMPILED"
"""Environment variable: when set, and not empty, steps run as Python."""

F = TypeVar("F", bound=Callable[..., Any])


class Floats:
    """Array of float64."""

    dtype, c = np.float64, "double *"

    def __getitem__(self, i: int) -> float: ...  # type: ignore[empty-body]
    def __setitem__(self, i: int, value: float) -> None: ...


class Integers:
    """Array of int64."""

    dtype, c = np.int64, "int64_t *"

    def __getitem__(self, i: int) -> int: ...  # type: ignore[empty-body]
    def __setitem__(self, i: int, value: int) -> None: ...


class Flags:
    """Array of bool."""

    dtype, c = np.bool_, "uint8_t *"

    def __getitem__(self, i: int) -> bool: ...  # type: ignore[empty-body]
    def __setitem__(self, i: int, value: bool) -> None: ...


ARRAYS = (Floats, Integers, Flags)


def checksum() -> int:
    """Return a check sum of all that a library is made of."""
    total = 0
    for name in (*MODULES, "sioms.native.translate", "sioms.native.language"):
        total = zlib.crc32(_source(name).read_bytes(), total)
    return total


def _source(module: str) -> Path:
    return Path(__file__).parents[2].joinpath(*module.split(".")).with_suffix(".py")


def _load() -> ctypes.CDLL | None:
    if os.environ.get(UNCOMPILED) or not LIBRARY.exists():
        return None
    library = ctypes.CDLL(str(LIBRARY))
    made_of = ctypes.c_uint32.in_dll(library, "sioms_checksum").value
    return library if made_of == checksum() else None


library = _load()
"""The compiled steps; None: they run as Python."""


class Record:
    """Numbers and arrays that steps work on, declared by annotations: int, float, Floats, Integers, Flags, records.

    Args:
        fields: a value for each; arrays are used where they are, not copied, and must stay where they are.

    Raises:
        TypeError: a field is missing, unknown, or of another kind.
    """

    kinds: dict[str, Any]

    def __init_subclass__(cls) -> None:
        cls.kinds = {name: kind for name, kind in get_type_hints(cls).items() if name not in ("kinds", "pointer")}

    def __init__(self, **fields: Any) -> None:
        name = type(self).__name__
        if fields.keys() != self.kinds.keys():
            wrong = ", ".join(sorted(fields.keys() ^ self.kinds.keys()))
            raise TypeError(f"make {name}: missing or unknown: {wrong}")
        if library is None:
            for field, value in fields.items():
                setattr(self, field, _viewed(name, field, self.kinds[field], value))
            return
        self.__dict__["_keep"] = dict(fields)  # arrays live as long as what points to them
        self.__dict__["_c"] = made = _structure(type(self))()
        self.__dict__["pointer"] = ctypes.byref(made)
        for field, value in fields.items():
            if isinstance(value, Record):
                setattr(made, field, ctypes.addressof(value.__dict__["_c"]))
            elif self.kinds[field] in ARRAYS:
                setattr(made, field, _checked(name, field, self.kinds[field], value).ctypes.data)
            else:
                setattr(made, field, value)
        self.__class__ = _compiled(type(self))

    pointer: Any


def _compiled(cls: type) -> type:
    """Return the class of records that live in C memory."""
    found = _CLASSES.get(cls)
    if found is None:
        names: dict[str, Any] = {}
        for field, kind in cls.kinds.items():  # type: ignore[attr-defined]
            if kind in (int, float):
                names[field] = _number(field)
            else:
                names[field] = property(lambda self, field=field: self.__dict__["_keep"][field])
        found = _CLASSES[cls] = type.__new__(type, cls.__name__, (cls,), names)
    return found


def _number(field: str) -> property:
    def get(self: Any) -> Any:
        return getattr(self.__dict__["_c"], field)

    def put(self: Any, value: Any) -> None:
        setattr(self.__dict__["_c"], field, value)

    return property(get, put)


_CLASSES: dict[type, type] = {}
_STRUCTURES: dict[type, type[ctypes.Structure]] = {}


def _structure(cls: type) -> type[ctypes.Structure]:
    """Return the layout of a record in C."""
    found = _STRUCTURES.get(cls)
    if found is None:
        numbers = {int: ctypes.c_int64, float: ctypes.c_double}
        fields = [(name, numbers.get(kind, ctypes.c_void_p)) for name, kind in cls.kinds.items()]  # type: ignore[attr-defined]
        found = _STRUCTURES[cls] = type(cls.__name__, (ctypes.Structure,), {"_fields_": fields})
    return found


def _checked(name: str, field: str, kind: Any, value: NDArray[Any]) -> NDArray[Any]:
    if not isinstance(value, np.ndarray) or value.dtype != kind.dtype or not value.flags.c_contiguous:
        raise TypeError(f"make {name}: {field} is {value!r:.80}; want a contiguous array of {kind.dtype.__name__}")
    return value


def _viewed(name: str, field: str, kind: Any, value: Any) -> Any:
    if kind not in ARRAYS:
        return value
    return memoryview(_checked(name, field, kind, value).reshape(-1))


def step(function: F) -> F:
    """Make a function a step: it takes records and numbers, returns a number or nothing."""
    if library is None:
        return function
    compiled = library[PREFIX + function.__name__]
    hints = get_type_hints(function)
    compiled.restype = {int: ctypes.c_int64, float: ctypes.c_double}.get(hints.pop("return"))
    kinds = list(hints.values())
    numbers = {int: ctypes.c_int64, float: ctypes.c_double}
    compiled.argtypes = [numbers.get(kind, ctypes.c_void_p) for kind in kinds]
    if not kinds or not issubclass(kinds[0], Record):
        return compiled  # type: ignore[return-value]
    match len(kinds):  # without a loop: it runs in every tick
        case 1:
            return lambda a: compiled(a.pointer)  # type: ignore[return-value]
        case 2:
            return lambda a, b: compiled(a.pointer, b)  # type: ignore[return-value]
        case _:
            return lambda a, *b: compiled(a.pointer, *b)  # type: ignore[return-value]


def load_all() -> None:
    """Import all modules of steps."""
    for name in MODULES:
        importlib.import_module(name)
