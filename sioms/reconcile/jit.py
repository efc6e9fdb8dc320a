"""Compile the scalar kernels with numba where it is installed, else run them as they are.

numba is loaded when the first kernel is compiled, not before: a simulated device that only evaluates effects
never pays for it. The plain path gives the same numbers some hundred times slower (decision 0061).
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from typing import Any, TypeVar

import numpy as np

F = TypeVar("F", bound=Callable[..., Any])

#: Signature of every state function of an effect: (x, v, u, temperature, parameters) -> value, as C code takes it.
STATE_SIGNATURE = "float64(float64, float64, float64, float64, CPointer(float64))"
STATE_ARGUMENTS = 5


@cache
def numba() -> Any:
    """Return the module numba, None where it is not installed or SIOMS_PLAIN is set."""
    if os.environ.get("SIOMS_PLAIN") is not None:
        return None
    try:
        return import_module("numba")
    except ImportError:
        return None


def addresses(functions: Sequence[Callable[..., Any]]) -> Any:
    """Return what ``caller`` finds state functions in: compiled, their addresses; as they are, themselves."""
    ready = [compiled(f) for f in functions]
    return ready if numba() is None else np.array([f.address for f in ready], dtype=np.int64)


def caller() -> Callable[..., float]:
    """Return the call of state function k of several with row k of parameters: ``(functions, k, rows, x, v, u,
    temperature)``.

    Compiled, it is a jump to an address. Functions as numba's own values cost four to eleven times as much (decision
    0174), arrays as arguments are counted.
    A kernel is kept on disk by its own file: when this changes, ``kernel.py`` must, or it goes on with what it was
        compiled with.
    """
    if numba() is None:
        return lambda functions, k, rows, *state: float(functions[k](*state, rows[k]))
    ir = import_module("llvmlite.ir")
    types = import_module("numba.core.types")

    @import_module("numba.extending").intrinsic  # type: ignore[untyped-decorator]
    def call(typing: Any, functions: Any, k: Any, rows: Any, x: Any, v: Any, u: Any, temperature: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            codes, index, table, *state = arguments
            code = builder.load(builder.gep(context.make_array(functions)(context, builder, codes).data, [index]))
            place = context.make_array(rows)(context, builder, table)
            offset = builder.mul(builder.extract_value(place.strides, 0), index)
            start = builder.ptrtoint(place.data, offset.type)
            row = builder.inttoptr(builder.add(start, offset), place.data.type)
            number = ir.DoubleType()
            kind = ir.FunctionType(number, [*[number] * len(state), row.type]).as_pointer()
            return builder.call(builder.inttoptr(code, kind), [*state, row])

        return types.float64(functions, types.intp, rows, *[types.float64] * (STATE_ARGUMENTS - 1)), generate

    return call  # type: ignore[no-any-return]


def kernel(function: F) -> F:
    """Compile a loop over samples (cached on disk)."""
    return _compiled(function)


def inlined(function: F) -> F:
    """Compile a part of a kernel into its caller."""
    return _compiled(function, forceinline=True)


def _compiled(function: F, **options: bool) -> F:
    if numba() is None:
        return function
    done: F = numba().njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    return done


def state_function(function: F) -> F:
    """Mark a state function of an effect.

    Raises:
        TypeError: it does not take (x, v, u, temperature, p).
    """
    taken = len(inspect.signature(function).parameters)
    if taken != STATE_ARGUMENTS:
        raise TypeError(
            f"define state function {function.__name__}: it takes {taken} arguments; needs (x, v, u, temperature, p)"
        )
    return function


@cache
def compiled(function: Callable[..., Any]) -> Any:
    """Return the compiled form of a state function; all of them have one type.

    Raises:
        TypeError: it does more than numba can make of numbers.
    """
    if numba() is None:
        return function
    try:
        return numba().cfunc(STATE_SIGNATURE, cache=True, error_model="numpy")(function)
    except import_module("numba.core.errors").NumbaError as error:
        lines = str(error).splitlines()
        reason = lines[min(1, len(lines) - 1)]  # the first line says which step of numba's
        raise TypeError(
            f"compile state function {function.__name__} of {function.__module__}: {reason}; "
            "needs arithmetic and numpy's functions of x, v, u, temperature and single p[i]"
        ) from error
