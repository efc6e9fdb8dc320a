"""The connection to a daemon, the blocking face."""

from __future__ import annotations

from sioms.protocol.socketpath import cell_address

from .cell_verbs import NodeEntry, WorkcellVerbs, is_part
from .channel import ENOUGH_LOOK_S, Channel
from .connecting import CONNECT_S, connect_channel
from .faces import Blocking, BlockingWaiter, begin
from .node import NODE, Node
from .session import MarkerVerbs
from .title import title

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any, Self, TypeVar, overload

    N = TypeVar("N", bound=Node[Any])

__all__ = ["Marker", "NodeEntry", "Workcell", "is_part"]


class Marker(Blocking, MarkerVerbs):
    __doc__ = MarkerVerbs.__doc__


class Workcell(Blocking, WorkcellVerbs[Marker]):
    """A session with the daemon. Use it in a ``with`` block, or close it; the end of the process does.

    Args:
        path: the daemon's socket, or ``zmq://HOST:PORT`` or ``zenoh://HOST:PORT`` of a gateway; None for $SIOMS_CELL,
            $SIOMS_SOCKET or the usual places.
        name: what this client calls itself in messages and lists; None for how it was started.
        enough: tells of a daemon that does not answer at once whether the session is not needed any more.

    Raises:
        OSError: no daemon there, or of another protocol version; a gateway that does not let one in.

    Concurrency: may be used by many threads.
    """

    _NODE, _NODES, _MARKER = Node, NODE, Marker

    def __init__(
        self, path: str | None = None, name: str | None = None, *, enough: Callable[[], bool] | None = None
    ) -> None:
        path = path or cell_address()
        channel = connect_channel(path, CONNECT_S if enough is None else ENOUGH_LOOK_S)
        super().__init__(channel, BlockingWaiter(channel), path)
        begin(self._greet, title() if name is None else name, enough)

    def _waiter_of(self, channel: Channel) -> BlockingWaiter:
        return BlockingWaiter(channel)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    if TYPE_CHECKING:

        @overload
        def open(
            self,
            name: str,
            mode: str = "r",
            timeout: float | None = 0.0,
            *,
            lease: float = 0.0,
            kind: type[N],
        ) -> N: ...

        @overload
        def open(self, name: str, mode: str = "r", timeout: float | None = 0.0, *, lease: float = 0.0) -> Any: ...

    def open(
        self,
        name: str,
        mode: str = "r",
        timeout: float | None = 0.0,
        *,
        lease: float = 0.0,
        kind: type[Node[Any]] | None = None,
    ) -> Any:
        return begin(self._open, name, mode, timeout, lease, kind)

    open.__doc__ = WorkcellVerbs._open.__doc__
