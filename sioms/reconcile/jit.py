"""Compile the scalar kernels with numba where it is installed, else run them as they are.

The plain path gives the same numbers some sixty times slower (docs/reconcile.md, "Time").
"""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import import_module
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

#: Signature of every state function of an effect: (x, v, u, temperature, parameters) -> value.
STATE_SIGNATURE = "float64(float64, float64, float64, float64, float64[::1])"

numba: Any = None
TypedList: Any = list
try:
    if os.environ.get("SIOMS_PLAIN") is None:  # set it to run without compiling
        numba = import_module("numba")
        TypedList = import_module("numba.typed").List
except ImportError:
    pass

COMPILED = numba is not None


def kernel(function: F) -> F:
    """Compile a loop over samples (cached on disk)."""
    if numba is None:
        return function
    compiled: F = numba.njit(cache=True)(function)
    return compiled


def state_function(function: F, *, cache: bool = True) -> F:
    """Compile one state function with the common signature, so that all of them have one type."""
    if numba is None:
        return function
    compiled: F = numba.njit(STATE_SIGNATURE, cache=cache)(function)
    return compiled


@kernel
def _listed(functions: Any) -> Any:
    out = TypedList()
    for f in functions:
        out.append(f)
    return out


def function_list(functions: tuple[Any, ...]) -> Any:
    """Return state functions in the container that a compiled kernel takes at no cost per call."""
    return functions if numba is None else _listed(functions)


def plain(function: F) -> F:
    """Return the uncompiled form, which takes arrays of axes elementwise (a simulated plant uses it)."""
    uncompiled: F = getattr(function, "py_func", function)
    return uncompiled
