"""A stream of writes that does not wait for each acknowledgement.

A write to a node is one round trip. A stream keeps several under way, so that its rate is that of
its source; a refusal ends it, and nothing that was written after the refused one counts as taken.
"""

from __future__ import annotations

from select import POLLIN, poll

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

    from .channel import Call
    from .node import Node
    from .node_core import Records

AHEAD = 64
"""Writes under way at most; beyond it a write waits for the oldest: back-pressure by the command buffer."""


class Stream:
    """Writes to one open node, in order, acknowledged later.

    Concurrency: one thread.

    Args:
        node: open for writing.
        ahead: writes under way at most.
    """

    def __init__(self, node: Node, ahead: int = AHEAD) -> None:
        self.node = node
        self._channel = node._channel
        self._ahead = ahead
        self._pending: list[tuple[int, Call]] = []
        self._poll = poll()
        self._poll.register(self.fileno(), POLLIN)

    def fileno(self) -> int:
        """Return a descriptor that is readable when ``settle`` has something to do, or the driver has gone."""
        return self._channel.fileno()

    def write(self, records: Records, *, replace: bool = False) -> None:
        """Send records; wait only when too many are under way, e.g. because the command buffer is full.

        Raises:
            OSError: the driver has gone, or has refused an earlier write.
        """
        call = self.node._write(records, None, replace)
        self._pending.append((self._channel.send(call), call))
        self.settle()
        while len(self._pending) > self._ahead:
            self._oldest()

    def settle(self) -> None:
        """Take the acknowledgements that have come, without waiting.

        Raises:
            OSError: a write was refused, or the driver has gone.
        """
        while self._poll.poll(0):
            if not self._pending:
                self._channel.take()  # unasked: the end of the connection, with or without a reason
                return
            self._oldest()

    def drain(self) -> None:
        """Wait until all writes are acknowledged.

        Raises:
            OSError: one was refused, or the driver has gone.
        """
        while self._pending:
            self._oldest()

    def _oldest(self) -> None:
        number, call = self._pending.pop(0)
        self._channel.wait(number, call)


def keep_together(nodes: Sequence[Node]) -> None:
    """Renew the leases of all these nodes whenever that of one is renewed, as by a call that waits on it."""
    channels = [node._channel for node in nodes]
    for channel in channels:
        channel.fellows = channels
