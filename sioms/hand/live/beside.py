"""What the devices of a hand tell by themselves, uncorrected: joints as the encoders read them, commands, wrists.

The hand's own coordinates are behind the springs that it knows of; what is to show those springs must not be.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any, Self

from sioms.client.workcell import Workcell
from sioms.hand.touch import Felt

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

    def read(self, fingers: Sequence[Felt]) -> list[float]:
        """Return a row of a survey, nan where not known (``sioms.hand.survey.Told``).

        Args:
            fingers: as they told it, of the same instant.
        """
        joints, commands, forces = list[float](), list[float](), list[float]()
        for node in self._modules:
            shown = node.read()
            joints += shown.position
            commands += [at + behind for at, behind in zip(shown.position, shown.following_error, strict=True)]
        for node in self._wrists:
            forces += _forces(node.read())
        felt = [*(finger.phi for finger in fingers), *(finger.force for finger in fingers)]
        return [float(v) for v in (*joints, *felt, *commands, *(forces or (*UNKNOWN, *UNKNOWN)))]


def _forces(shown: Any) -> Sequence[float]:
    """Return fx and fy of a force sensor, unknown where it cannot tell them."""
    try:
        return [shown.measured(i) for i in (0, 1)]
    except OSError:
        return UNKNOWN
