"""Who has made a connection, by the kernel of this machine."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from sioms import bridges
from sioms.bridges.putters import Putters, user_of

STRANGER = 60124


def connection(host: str = "127.0.0.1") -> tuple[socket.socket, socket.socket, socket.socket]:
    """Return a listener, and both ends of a connection to it: the client's, ours."""
    listener = socket.create_server((host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    client = socket.create_connection(listener.getsockname()[:2])
    return listener, client, listener.accept()[0]


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_the_owner_of_a_connection_is_known_until_he_closes_it(host: str) -> None:
    listener, client, ours = connection(host)
    with listener, ours:
        peer, here = client.getsockname()[:2], ours.getsockname()[:2]
        assert user_of(peer, here) == os.geteuid()
        putters = Putters()
        putters.here = here
        putters.judge(f"[{peer[0]}]:{peer[1]}" if ":" in host else f"{peer[0]}:{peer[1]}", stops=False)
        client.close()
        assert user_of(peer, here) is None, "of a closed end the kernel says 0, which is root"
        with pytest.raises(PermissionError, match="is not a connection of a user of this machine"):
            putters.judge(f"{peer[0]}:{peer[1]}", stops=True)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be two users")
def test_another_user_is_another_one() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        here = listener.getsockname()
        program = f"import os, socket; os.setuid({STRANGER}); s = socket.socket(); s.connect({here!r}); input()"
        with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE) as stranger:
            listener.settimeout(20.0)
            ours, peer = listener.accept()
            with ours:
                assert user_of(peer, here) == STRANGER
                putters = Putters()
                putters.here = ("*", here[1])
                with pytest.raises(PermissionError, match=f"user {STRANGER}; want one of user root on this machine"):
                    putters.judge("{}:{}".format(*peer), stops=True)
            stranger.communicate(b"\n")


def test_nothing_that_is_not_a_connection_of_this_machine_passes() -> None:
    putters = Putters()
    putters.here = ("127.0.0.1", 5075)
    for peer in ("", "nonsense", "10.0.0.1:5000", "127.0.0.1:99999999", "127.0.0.1:-1", "127.0.0.1:0", "[::1:5", ":"):
        with pytest.raises(PermissionError):
            putters.judge(peer, stops=True)
        Putters(anybody_stops=True).judge(peer, stops=True)
    with pytest.raises(OSError, match="allow nobody-here to put: no such user"):
        Putters(["nobody-here"])


def test_bridges_that_only_show_open_nothing_that_moves() -> None:
    for module in ("metrics", "ros2"):
        text = (Path(bridges.__file__).parent / f"{module}.py").read_text(encoding="utf-8")
        opened = re.findall(r"cell\.open\((.*)\)", text)
        assert opened == ["entry.name if entry.read_only else entry.name + READONLY"], module
        assert not re.search(r"\.(move|write|ioctl|stop|emergency_stop|reset|signal|synch)\(", text), module
