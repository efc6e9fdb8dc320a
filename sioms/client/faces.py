"""Two faces, blocking and asyncio, of one list of verbs.

A verb is written once, as a coroutine function of a class that neither face sees: it awaits other verbs, by their
class, and the calls of a ``Waiter``. asyncio's face inherits it as it is. In the blocking face the waiter waits in its
calls, so that a coroutine runs to its end without ever being suspended, and ``Blocking`` puts a plain function in the
place of each.
"""

from __future__ import annotations

from itertools import starmap
from select import POLLIN, poll
from time import sleep

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Iterator
    from functools import partial
    from typing import Any, TypeVar

    from .channel import Answer, Call, Channel

    R = TypeVar("R")
else:
    from _functools import partial  # functools takes a shell tool a tenth of its start time

_COROUTINE, _ASYNC_GENERATOR = 0x80, 0x200
_FUNCTION = type(lambda: None)
_NONE = (None,)


async def _nothing() -> None:
    """Be a coroutine."""


(_made := _nothing()).close()
_SEND: Any = type(_made).send


class Awaiting:
    """The asyncio face: verbs are awaited."""


class Blocking:
    """The blocking face: verbs wait. It is the first base of its classes, or an ancestor of that."""

    def __init_subclass__(cls) -> None:
        done = cls.__bases__[0].__mro__
        for base in cls.__mro__:
            if base in done or base.__module__ == "builtins":
                continue
            for name, function in vars(base).items():
                if type(function) is _FUNCTION and name[0] != "_" and name not in vars(cls):
                    if function.__code__.co_flags & _COROUTINE:
                        setattr(cls, name, _told(_blocking, function))
                    elif function.__code__.co_flags & _ASYNC_GENERATOR:
                        setattr(cls, name, _told(_yielding, function))


def run(steps: Coroutine[Any, Any, R]) -> R:
    """Run a coroutine that waits in the blocking face, and return what it returns."""
    try:
        steps.send(None)
    except StopIteration as end:
        value: R = end.value
        return value
    steps.close()
    raise RuntimeError("a verb of the blocking face waits for an event loop")


def begin(function: Callable[..., Coroutine[Any, Any, R]], *arguments: Any) -> R:
    """Run the coroutine that a function makes of its arguments.

    It is made and begun in one call of C: by a signal between the two, it would be told that it was never awaited.
    """
    try:
        next(map(_SEND, starmap(function, (arguments,)), _NONE))
    except StopIteration as end:
        value: R = end.value
        return value
    raise RuntimeError("a verb of the blocking face waits for an event loop")


def _blocking(function: Any) -> Any:
    def face(self: Any, *arguments: Any, **words: Any) -> Any:
        return begin(partial(function, self, **words), *arguments)

    return face


def _yielding(function: Any) -> Any:
    def face(self: Any, *arguments: Any, **words: Any) -> Iterator[Any]:
        values = function(self, *arguments, **words)
        try:
            while True:
                yield run(values.__anext__())
        except StopAsyncIteration:
            return
        finally:
            run(values.aclose())

    return face


def _told(make: Callable[[Any], Any], function: Any) -> Any:
    """Make a face of a verb that has its name, signature and documentation."""
    face = make(function)
    face.__wrapped__ = function
    for name in ("__name__", "__qualname__", "__module__", "__doc__"):
        setattr(face, name, getattr(function, name))
    return face


class BlockingWaiter:
    """What waits in the blocking face. Concurrency: any number of threads."""

    __slots__ = ("_channel",)

    def __init__(self, channel: Channel | None) -> None:
        self._channel = channel

    async def call(self, call: Call) -> Answer:
        """Send a request and wait for its answer."""
        return self._channel.call(call)  # type: ignore[union-attr]

    async def readable(self, fds: Iterable[int], timeout_s: float | None) -> set[int]:
        """Wait until one of several descriptors is readable; return those that are, none when the time is over."""
        poller = poll()
        for fd in fds:
            poller.register(fd, POLLIN)
        return {fd for fd, _ in poller.poll(None if timeout_s is None else 1e3 * timeout_s)}

    async def pause(self, seconds: float) -> None:
        """Let time pass."""
        sleep(seconds)

    def close(self) -> None:
        """Close the channel; waiting threads get EBADF."""
        if self._channel is not None:
            self._channel.close()
