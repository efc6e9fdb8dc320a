"""The seam between nodes and what carries them; type checkers see it, running programs load nothing of it.

A node has its snapshots from ``Readings`` and sends its requests through a ``Waiter`` (``typed_faces``); nothing else
of it knows of sockets, shared memory or descriptors that are passed. ``local`` and ``channel`` are the transport on one
machine. Another one, as to
another machine or out of a recording, brings both of its own and the same node on top:
    tests/unit/client/test_transport.py does.
"""

from __future__ import annotations

from typing import Protocol


class Readings(Protocol):
    """The newest snapshots of a node, and what tells that there is a new one.

    Attributes:
        channels: of the block, of which the node shows some.
        slots: snapshots that are kept.
        device: of which driver process they are: nodes of one share what has been acknowledged.
    """

    channels: int
    slots: int
    device: int

    @property
    def head(self) -> int:
        """Number of the newest snapshot; 0 before the first."""

    @property
    def closed(self) -> bool:
        """Whether it has been released."""

    def latest(self, now_ns: int) -> bytes:
        """Copy the newest snapshot, slot header included; raises NotReadable, as ``PageReader.latest``."""

    def numbered(self, number: int) -> bytes | None:
        """Copy a snapshot by its number; None when it is not kept any more, or not there yet."""

    def check(self, now_ns: int) -> None:
        """Raise NotReadable unless snapshots are good."""

    def fileno(self) -> int:
        """Return a descriptor that is readable after a publication that was subscribed to."""

    def drain(self) -> None:
        """Make the descriptor unreadable until the next publication."""

    def release(self) -> None:
        """Let go of everything."""
