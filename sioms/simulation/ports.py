"""Serial ports that can be unplugged: a pty whose slave a master opens by a fixed link."""

from __future__ import annotations

import asyncio
import os
import termios
import tty
from collections.abc import Callable
from pathlib import Path


class PtyPort:
    """One end of a pty; the other is opened by name.

    Args:
        link: fixed path for the port's name, or None.
        received: called with the bytes that arrive.

    Concurrency: the event loop that it was plugged in.
    """

    def __init__(self, link: Path | None, received: Callable[[bytes], None]) -> None:
        self._link, self._received = link, received
        self._master = self._slave = -1
        self.name = ""

    @property
    def plugged(self) -> bool:
        """Whether the port exists."""
        return self._master >= 0

    def plug(self) -> None:
        """Make the port appear, under a new name and the old link."""
        if self.plugged:
            return
        # the slave stays open here, so that a master closing it does not end the port
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.name = os.ttyname(self._slave)
        asyncio.get_running_loop().add_reader(self._master, self._read)
        if self._link is not None:
            make_link(self._link, self.name)

    def unplug(self) -> None:
        """Make the port vanish; a master that has it open gets an error and a hang-up."""
        if not self.plugged:
            return
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        asyncio.get_running_loop().remove_reader(self._master)
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1

    def write(self, data: bytes) -> bool:
        """Send; what does not fit while nobody reads is lost, as on a wire. Returns whether all of it left."""
        if not self.plugged or not data:
            return True
        try:
            return os.write(self._master, data) == len(data)
        except BlockingIOError:
            return False

    def _read(self) -> None:
        try:
            data = os.read(self._master, 4096)
        except OSError:
            return
        if data:
            allow_parity(self._slave)
            self._received(data)


def allow_parity(slave: int) -> None:
    """Let the next master ask for parity, which a pty does not have.

    Linux refuses (EINVAL) settings of which it takes nothing over. A flag without effect (ECHOCTL while nothing
    is echoed), which every master clears, leaves something to take.
    """
    settings = termios.tcgetattr(slave)
    if not settings[3] & termios.ECHOCTL:
        settings[3] |= termios.ECHOCTL
        termios.tcsetattr(slave, termios.TCSANOW, settings)


def make_link(link: Path, name: str) -> None:
    """Let a fixed path lead to a port."""
    fresh = link.with_name(f"{link.name}.{os.getpid()}")
    fresh.symlink_to(name)
    fresh.replace(link)
