"""What a transport of the gateway is, and what it needs of the loop that it lives in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from .core import Gateway
from .parts import Principal


class Loop(Protocol):
    """The gateway's loop, as transports see it.

    Attributes:
        gateway: the sessions.
    """

    gateway: Gateway

    def principal(self, public: str) -> Principal | None:
        """Return who holds a key, None: nobody who is admitted."""

    def add(self, fd: int, readable: Callable[[], None]) -> None:
        """Call back when a descriptor is readable."""

    def remove(self, fd: int) -> None:
        """Watch it no more."""

    def log(self, level: str, event: str, **words: object) -> None:
        """Write a line."""


class Transport(Protocol):
    """What brings frames of clients whose keys it has verified, and takes frames for them.

    Attributes:
        about: where it listens, for the log.
        pending: whether frames wait of which no descriptor tells.
    """

    about: dict[str, str]

    @property
    def pending(self) -> bool: ...

    def start(self) -> None:
        """Begin."""

    def owns(self, peer: bytes) -> bool:
        """Tell whether a peer is one of this transport."""

    def send(self, peer: bytes, frame: bytes) -> bool:
        """Send a frame to a client; False when it has gone, or takes no more."""

    def take(self) -> bool:
        """Take frames of clients; return whether there are more."""

    def look(self) -> None:
        """Do what is due ten times a second."""

    def close(self) -> None:
        """Let go of everything."""
