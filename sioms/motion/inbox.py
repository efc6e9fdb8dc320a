"""Short writes between their acknowledgement and the tick that works them in (decision 0023).

Concurrency: that of the bank.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .commands import Command
from .plain import MOST
from .queue import AxesLike, CommandQueue
from .sequencer import Sequencer
from .store import NEVER_NS


class Taken(NamedTuple):
    """A short write that has been acknowledged and waits to be worked in.

    Args:
        commands: in order.
        axes: the bank axes they are for.
        replace: whether they replace what the axes do.
        now_ns: instant of the write.
    """

    commands: list[Command]
    axes: frozenset[int]
    replace: bool
    now_ns: int


class Inbox:
    """Keeps short writes for the next tick or verb, which carries each out at its own instant.

    The writer has its acknowledgement sooner, and set-points that are replaced before any tick has seen
    them are never planned.

    Args:
        queue, sequencer: of the bank.
        instant: gives the instant at which a verb of a given time acts [ns].
    """

    def __init__(self, queue: CommandQueue, sequencer: Sequencer, instant: Callable[[int], int]) -> None:
        self._queue = queue
        self._sequencer = sequencer
        self._instant = instant
        self._writes: list[Taken] = []

    def offer(
        self, records: Sequence[tuple[Any, ...]], axes: AxesLike, now_ns: int, *, replace: bool
    ) -> bool:
        """Take a write; False, and nothing taken, when it is not plain, bad, or too long."""
        waiting = sum([len(write.commands) for write in self._writes]) if self._writes else 0
        commands = self._queue.admit_plain(records, axes, waiting, replace=replace)
        if commands is None:
            return False
        touched = frozenset([command.axis for command in commands])
        if replace and self._writes:
            self._writes = [older for older in self._writes if not older.axes <= touched]
        self._writes.append(Taken(commands, touched, replace, now_ns))
        if len(self._writes) > MOST:
            self.work_in()
        return True

    def work_in(self, latest_ns: int = NEVER_NS) -> None:
        """Carry out all writes, each at its own instant, or at latest_ns."""
        if not self._writes:
            return
        writes, self._writes = self._writes, []
        for write in writes:
            at_ns = self._instant(min(write.now_ns, latest_ns))
            self._sequencer.advance(at_ns)
            # Working in an earlier one may have ended in a fault.
            commands = [c for c in write.commands if not self._queue.is_barred(c.axis)]
            if not commands:
                continue
            axes = np.array(sorted({c.axis for c in commands}), dtype=np.int64)
            if write.replace:
                self._sequencer.drop(axes)
            self._queue.append_plain(commands, axes)
            if write.replace:
                self._sequencer.replaced(axes, at_ns)
            else:
                self._sequencer.appended(axes, at_ns)

    def forget(self, axes: NDArray[np.int64]) -> None:
        """Drop the writes to these axes."""
        if not self._writes:
            return
        dropped = frozenset(axes.tolist())
        left = [(write, [c for c in write.commands if c.axis not in dropped]) for write in self._writes]
        self._writes = [write._replace(commands=cs, axes=write.axes - dropped) for write, cs in left if cs]
