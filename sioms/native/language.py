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

Numbers are ``int`` (64 bits) and ``float`` (double); arrays are contiguous and made by numpy. There are assignments,
``if``, ``while``, ``for`` over a ``range``, arithmetic, comparisons, the functions of ``system`` and calls of other
steps. A variable keeps the kind of its first value. A division by zero raises in Python and is not a number in C: steps
do not divide by what may be zero.
"""

from __future__ import annotations

import ctypes
import os
import weakref
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar, cast, get_type_hints

import numpy as np

MODULES: tuple[str, ...] = (
    "sioms.motion.axis_step",
    "sioms.motion.plan_step",
    "sioms.motion.stop_step",
    "sioms.motion.begin_step",
    "sioms.motion.plain_step",
    "sioms.plant.friction_step",
    "sioms.plant.motor_step",
    "sioms.plant.stepper_step",
    "sioms.plant.binary_step",
    "sioms.plant.planar_step",
    "sioms.sdk.serve_step",
    "sioms.sdk.quiet_step",
    "sioms.drivers.sim.axes_step",
)
"""Modules whose records and steps are compiled, each after those that it uses."""
PREFIX = "sioms_"
"""Of all names in the library: those of the C library are not ours."""
OWN = ("sioms.native.language", "sioms.native.numbers", "sioms.native.system", "sioms.native.translate")
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


class Bytes:
    """Array of uint8; what is put into it is below 256."""

    dtype, c = np.uint8, "uint8_t *"

    def __getitem__(self, i: int) -> int: ...  # type: ignore[empty-body]
    def __setitem__(self, i: int, value: int) -> None: ...


class Flags:
    """Array of bool."""

    dtype, c = np.bool_, "uint8_t *"

    def __getitem__(self, i: int) -> bool: ...  # type: ignore[empty-body]
    def __setitem__(self, i: int, value: bool) -> None: ...


ARRAYS = (Floats, Integers, Flags, Bytes)
_DTYPES: dict[Any, np.dtype[Any]] = {kind: np.dtype(kind.dtype) for kind in ARRAYS}


class Call:
    """A step that a record names: it takes a record and three int and returns an int."""

    def __call__(self, record: Context, a: int, b: int, c: int) -> int: ...  # type: ignore[empty-body]


class Context:
    """The record for such a step, whatever it is."""


NUMBERS: dict[Any, Any] = {int: ctypes.c_int64, float: ctypes.c_double}


def checksum() -> int:
    """Return a check sum of all that a library is made of."""
    total = 0
    for name in (*MODULES, *OWN):
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


ADDRESS = "address_of_"
"""What the fields of a record are called in C that point to arrays and other records."""
NOT_FIELDS = ("kinds", "in_c", *get_type_hints(ctypes.Structure))


class Record(ctypes.Structure):
    """Numbers and arrays that steps work on, declared by annotations: int, float, arrays of ARRAYS, records.

    Args:
        fields: a value for each; arrays are used where they are, not copied, and must stay where they are.

    Raises:
        TypeError: a field is missing, unknown, or of another kind.
    """

    kinds: ClassVar[dict[str, Any]]
    in_c: ClassVar[bool]

    def __init_subclass__(cls) -> None:
        cls.in_c = library is not None
        cls.kinds = {name: kind for name, kind in get_type_hints(cls).items() if name not in NOT_FIELDS}

    def __new__(cls, **_: Any) -> Self:
        cls.lay_out()
        return super().__new__(cls)

    @classmethod
    def lay_out(cls) -> None:
        """Give the structure its fields, once; that can only be done when the class is complete."""
        if cls.in_c and "_fields_" not in cls.__dict__:
            cls._fields_ = [
                (name, NUMBERS[kind]) if kind in NUMBERS else (ADDRESS + name, ctypes.c_void_p)
                for name, kind in cls.kinds.items()
            ]

    def __init__(self, **fields: Any) -> None:
        name = type(self).__name__
        if fields.keys() != self.kinds.keys():
            wrong = ", ".join(sorted(fields.keys() ^ self.kinds.keys()))
            raise TypeError(f"make {name}: missing or unknown: {wrong}")
        for field, kind in self.kinds.items():
            if kind in ARRAYS:
                value = fields[field]
                if not isinstance(value, np.ndarray) or value.dtype != _DTYPES[kind] or not value.flags.c_contiguous:
                    wanted = kind.dtype.__name__
                    raise TypeError(f"make {name}: {field} is {value!r:.80}; want a contiguous array of {wanted}")
        if not self.in_c:
            for field, value in fields.items():
                setattr(self, field, value.reshape(-1).data if self.kinds[field] in ARRAYS else value)
            return
        for field, value in fields.items():
            setattr(self, field, value)  # an array lives as long as what points to it
            if self.kinds[field] not in NUMBERS:
                setattr(self, ADDRESS + field, _address(value))

    @property
    def address(self) -> int:
        """A number by which steps find the record in an array of such, as long as it is kept elsewhere."""
        _records[number := ctypes.addressof(self) if self.in_c else id(self)] = self
        return number

    @classmethod
    def empty(cls) -> Self:
        """Return a record of nothing: numbers 0, arrays without elements."""
        fields: dict[str, Any] = {}
        for name, kind in cls.kinds.items():
            if kind in ARRAYS:
                fields[name] = np.zeros(0, kind.dtype)
            else:
                fields[name] = kind(0) if kind in NUMBERS else kind.empty()
        return cls(**fields)


_records: weakref.WeakValueDictionary[int, Record] = weakref.WeakValueDictionary()


def record_of(address: int) -> Record:
    """Return the record that has an address."""
    return _records[address]


def _address(value: Any) -> int:
    if isinstance(value, Record):
        return ctypes.addressof(value)
    if isinstance(value, np.ndarray):
        address: int = value.__array_interface__["data"][0]
        return address
    return ctypes.cast(value, ctypes.c_void_p).value or 0


def step(function: F) -> F:
    """Make a function a step: it takes records and numbers, returns a number or nothing."""
    if library is None:
        return function
    compiled: Any = library[PREFIX + function.__name__]
    hints = get_type_hints(function)
    compiled.restype = NUMBERS.get(hints.pop("return"))
    compiled.argtypes = [_argument(kind) for kind in hints.values()]
    return cast("F", compiled)


def _argument(kind: Any) -> Any:
    """Return what ctypes has for an argument: of a record its address, which it takes itself."""
    if isinstance(kind, type) and issubclass(kind, Record):
        kind.lay_out()  # now, where drivers are forked from: they share it
        return ctypes.POINTER(kind)
    return NUMBERS.get(kind, ctypes.c_void_p)
