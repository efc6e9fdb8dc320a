"""What a running workcell tells of a hand beside its readings: commanded joints, and forces at the wrists."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any, Self

from sioms.client.workcell import Workcell

JOINTS = 3  # of a module: x, y, th
UNKNOWN = (math.nan, math.nan)


class Beside:
    """Reads modules and wrists; nothing is held, nothing moves.

    Args:
        cell: the session.
        modules: nodes of the axes x, y, th of module 1 and 2.
        wrists: force sensors of finger 1 and 2, fx and fy first; none for a hand without.

    Raises:
        OSError: a node that is not there, or has another number of channels.

    Concurrency: one thread.
    """

    def __init__(self, cell: Workcell, modules: Sequence[str], wrists: Sequence[str]) -> None:
        with ExitStack() as stack:
            self._modules: list[Any] = [stack.enter_context(cell.open(f"{name}.readonly")) for name in modules]
            self._wrists: list[Any] = [stack.enter_context(cell.open(name)) for name in wrists]
            for node in self._modules:
                if len(node.read().position) != JOINTS:
                    raise OSError(f"read module {node.name}: it has {len(node.read().position)} axes; want x, y and th")
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def read(self) -> list[float]:
        """Return x1, y1, th1, x2, y2, th2 as commanded [m, rad] and fx1, fy1, fx2, fy2 [N]; nan where not known."""
        out: list[float] = []
        for node in self._modules:
            shown = node.read()
            out += [at + behind for at, behind in zip(shown.position, shown.following_error, strict=True)]
        for node in self._wrists:
            out += _forces(node.read())
        return out if self._wrists else [*out, *UNKNOWN, *UNKNOWN]


def _forces(shown: Any) -> Sequence[float]:
    """Return fx and fy of a force sensor, unknown where it cannot tell them."""
    try:
        return [shown.measured(i) for i in (0, 1)]
    except OSError:
        return UNKNOWN
