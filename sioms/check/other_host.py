"""Two hosts with a cable between them, on one machine: network namespaces of Linux, for what no relay does, as a cable
that is pulled: nothing comes any more, and nobody is told.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Self

CELL, CLIENT = "10.213.77.1", "10.213.77.2"
"""Addresses of the two hosts; they exist in their namespaces only."""
_NEWNET = 0x40000000
_libc = ctypes.CDLL(None, use_errno=True)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


def available() -> bool:
    """Tell whether this user may make network namespaces here."""
    name = f"sioms-{os.getpid()}-try"
    try:
        _ip("netns", "add", name)
        _ip("netns", "del", name)
    except (OSError, subprocess.CalledProcessError):
        return False
    return True


class Hosts:
    """The two hosts. Use it in a ``with`` block."""

    def __init__(self) -> None:
        self._names = {CELL: f"sioms-{os.getpid()}-cell", CLIENT: f"sioms-{os.getpid()}-client"}

    def __enter__(self) -> Self:
        cell, client = self._names.values()
        try:
            for name in (cell, client):
                _ip("netns", "add", name)
                _ip("-n", name, "link", "set", "lo", "up")
            _ip("-n", cell, "link", "add", "cable", "type", "veth", "peer", "name", "cable", "netns", client)
            for address, name in self._names.items():
                _ip("-n", name, "address", "add", f"{address}/24", "dev", "cable")
                _ip("-n", name, "link", "set", "cable", "up")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for name in self._names.values():
            with suppress(subprocess.CalledProcessError):
                _ip("netns", "del", name)

    @contextmanager
    def on(self, address: str) -> Iterator[None]:
        """Be on a host: what this thread starts and connects inside of the block is there."""
        with open(f"/var/run/netns/{self._names[address]}") as there, open("/proc/thread-self/ns/net") as here:
            _enter(there.fileno())
            try:
                yield
            finally:
                _enter(here.fileno())

    def pull(self) -> None:
        """Pull the cable: packets are lost, without a word to either host."""
        _ip("-n", self._names[CLIENT], "link", "set", "cable", "down")


def _enter(fd: int) -> None:
    if _libc.setns(fd, _NEWNET):
        raise OSError(ctypes.get_errno(), "enter a network namespace")
