"""What type checkers see of ``marks``; nothing of it is loaded by a running program."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Iterator
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, overload
from typing import Generic as Generic

from .channel import Answer, Call
from .faces import Awaiting, Blocking

P = ParamSpec("P")
R = TypeVar("R")


class Sleeper(Protocol):
    """What waits, each face in its own way."""

    async def readable(self, fds: Iterable[int], timeout_s: float | None) -> set[int]:
        """Wait until one of several descriptors is readable; return those that are, none when the time is over."""

    async def pause(self, seconds: float) -> None:
        """Let time pass."""


class Waiter(Sleeper, Protocol):
    """The same, with a channel."""

    async def call(self, call: Call) -> Answer:
        """Send a request and wait for its answer."""

    def close(self) -> None:
        """End the requests in flight, and close their channel."""


class verb(Generic[P, R]):  # a decorator
    """A verb as type checkers see it: in each face it is that face's."""

    def __init__(self, function: Callable[Concatenate[Any, P], Coroutine[Any, Any, R]]) -> None: ...

    @overload
    def __get__(self, holder: Blocking, owner: object) -> Callable[P, R]: ...
    @overload
    def __get__(self, holder: Awaiting, owner: object) -> Callable[P, Coroutine[Any, Any, R]]: ...
    @overload
    def __get__(self, holder: None, owner: object) -> Callable[Concatenate[Any, P], Coroutine[Any, Any, R]]: ...
    def __get__(self, holder: Any, owner: object) -> Any: ...


class stream(Generic[P, R]):  # a decorator
    """The same for what yields one value after the other."""

    def __init__(self, function: Callable[Concatenate[Any, P], AsyncIterator[R]]) -> None: ...

    @overload
    def __get__(self, holder: Blocking, owner: object) -> Callable[P, Iterator[R]]: ...
    @overload
    def __get__(self, holder: Awaiting, owner: object) -> Callable[P, AsyncIterator[R]]: ...
    def __get__(self, holder: Any, owner: object) -> Any: ...
