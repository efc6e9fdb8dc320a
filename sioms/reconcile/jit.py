"""Compile the scalar kernels with numba where it is installed, else run them as they are.

numba is loaded when the first kernel is compiled, not before: a simulated device that only evaluates effects
never pays for it. The plain path gives the same numbers some sixty times slower (docs/reconcile.md, "Time").
"""

from __future__ import annotations

import inspect
import os
import warnings
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

#: Signature of every state function of an effect: (x, v, u, temperature, parameters) -> value.
STATE_SIGNATURE = "float64(float64, float64, float64, float64, float64[::1])"
STATE_ARGUMENTS = 5


@cache
def numba() -> Any:
    """Return the module numba, None where it is not installed or SIOMS_PLAIN is set."""
    if os.environ.get("SIOMS_PLAIN") is not None:
        return None
    # State functions are handed to the kernel as values, which numba calls experimental; the tests hold it to it.
    warnings.filterwarnings("ignore", message="First-class function type feature is experimental")
    try:
        return import_module("numba")
    except ImportError:
        return None


def typed_list() -> Any:
    """Return the list type that compiled code takes."""
    return list if numba() is None else import_module("numba.typed").List


def kernel(function: F) -> F:
    """Compile a loop over samples (cached on disk)."""
    if numba() is None:
        return function
    done: F = numba().njit(cache=True, nogil=True)(function)
    return done


def state_function(function: F) -> F:
    """Mark a state function of an effect.

    Raises:
        TypeError: it does not take (x, v, u, temperature, p).
    """
    taken = len(inspect.signature(function).parameters)
    if taken != STATE_ARGUMENTS:
        raise TypeError(
            f"define state function {function.__name__}: it takes {taken} arguments; "
            "needs (x, v, u, temperature, p)"
        )
    return function


@cache
def compiled(function: Callable[..., Any]) -> Any:
    """Return the compiled form of a state function; all of them have one type."""
    return function if numba() is None else numba().njit(STATE_SIGNATURE, cache=True)(function)
