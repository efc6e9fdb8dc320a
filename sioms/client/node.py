"""Open nodes, the blocking face.

Concurrency: a node may be used by many threads; each request has its own answer. Closing ends the
requests of other threads with EBADF.
"""

from __future__ import annotations

from sioms.protocol.flags import NodeClass, WriteFlag
from sioms.protocol.messages import MAX_INLINE, HandleVerb

from .faces import Blocking, BlockingWaiter, run
from .node_core import S
from .node_verbs import AnalogVerbs, AxisVerbs, BinaryVerbs, NodeVerbs, select_nodes
from .snapshot import AnalogSnapshot, AxisSnapshot, BinarySnapshot

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import Any, Self

    from .channel import Call
    from .coordinates import UserAxis
    from .node_core import Records

_WRITE, _APPEND, _REPLACE = int(HandleVerb.WRITE), int(WriteFlag.APPEND), int(WriteFlag.REPLACE)


class Node(Blocking, NodeVerbs[S]):
    """An open node, with calls that wait. Use it in a ``with`` block: closing halts its axes."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def fileno(self) -> int:
        """Return a descriptor that is readable when there is new data, for selectors and asyncio.

        The first call subscribes; ``read`` makes it unreadable until the next publication.
        """
        if not self._subscribed:
            self.subscribe(1)
        return super().fileno()

    def write(self, records: Records, timeout: float | None = 0.0, *, replace: bool = False) -> int:
        # As in the list, in fewer steps: this is the round trip of control loops, and their code is cold each time.
        def call() -> Call:
            return self._write(records, timeout, replace)

        if type(records) is not bytes or len(records) > MAX_INLINE or type(timeout) is not float or timeout != timeout:
            tick: int = self._channel.call(call()).value
        else:
            tick = self._channel.short_call((_WRITE, _REPLACE if replace else _APPEND, timeout, records), call)
        return tick

    write.__doc__ = NodeVerbs.write.__doc__


class AxisNode(Node[AxisSnapshot], AxisVerbs):
    __doc__ = AxisVerbs.__doc__

    def user(self, axis: int | str = 0, *, offset: float = 0.0, direction: int = 1) -> UserAxis:
        """Return one axis in coordinates of one's own: user = direction * position + offset."""
        from .coordinates import UserAxis

        return UserAxis(self, self.channel(axis), offset, direction)

    def __getitem__(self, axis: int | str) -> UserAxis:
        """Return one axis by index or name, ``arm["xaxis"]``, in the node's own coordinates."""
        return self.user(axis)


class AnalogNode(Node[AnalogSnapshot], AnalogVerbs):
    __doc__ = AnalogVerbs.__doc__


class BinaryNode(Node[BinarySnapshot], BinaryVerbs):
    __doc__ = BinaryVerbs.__doc__


NODE: dict[NodeClass, type[Node[Any]]] = {
    NodeClass.AXIS: AxisNode,
    NodeClass.ANALOG: AnalogNode,
    NodeClass.BINARY: BinaryNode,
}


def select(
    readable: Iterable[Node[Any]] = (), room: Iterable[AxisNode] = (), timeout: float | None = None
) -> tuple[list[Node[Any]], list[AxisNode]]:
    return run(select_nodes(BlockingWaiter(None), readable, room, timeout))


select.__doc__ = select_nodes.__doc__
