"""Where clients connect: one daemon each, in a folder where nobody can put another, and only what is a daemon is
believed.
"""

from __future__ import annotations

import errno
import os
import re
import socket
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from sioms.client.connecting import connect
from sioms.daemon.listening import Listening
from sioms.protocol.socketpath import own_path
from sioms.protocol.stopfile import open_stop_request

NOBODY = 65534
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")


@pytest.fixture
def path(short_folder: Path) -> str:
    """Return where to listen."""
    return str(short_folder / "d.sock")


def refused(path: str, number: int, words: str) -> None:
    """Show that nobody can listen at a path, and that nothing has been left there."""
    before = sorted(os.listdir(os.path.dirname(path)))
    with pytest.raises(OSError, match=words) as caught:
        Listening(path, 0o660, "")
    assert caught.value.errno == number
    assert sorted(os.listdir(os.path.dirname(path))) == before


def test_the_socket_is_there_when_it_listens_and_gone_afterwards(path: str) -> None:
    listening = Listening(path, 0o640, "")
    assert stat.S_IMODE(os.stat(path).st_mode) == 0o640
    assert sorted(os.listdir(os.path.dirname(path))) == ["d.sock", "d.sock.lock"]
    connect(path).close()
    listening.close()
    assert os.listdir(os.path.dirname(path)) == []


def test_who_comes_second_is_refused_and_told_who_is_first(path: str) -> None:
    first = Listening(path, 0o660, "")
    refused(path, errno.EADDRINUSE, rf"another daemon \(pid {os.getpid()}\) serves {re.escape(path)}; stop it")
    os.unlink(path)  # the lock holds without the socket
    refused(path, errno.EADDRINUSE, "another daemon")
    first.close()
    Listening(path, 0o660, "").close()


def test_a_folder_that_somebody_has_mistyped_is_not_made(short_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    missing = short_folder / "missing"
    with pytest.raises(
        OSError, match=f"the folder {missing} does not exist; create it or choose another path"
    ) as caught:
        Listening(f"{missing}/d.sock", 0o660, "")
    assert caught.value.errno == errno.ENOENT and not missing.exists()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(missing))
    listening = Listening(own_path(), 0o660, "")
    assert os.listdir(missing) == ["sioms"]
    listening.close()


def test_what_a_dead_daemon_has_left_is_taken_over(path: str) -> None:
    script = f"import os, sioms.daemon.listening as it; it.Listening({path!r}, 0o660, ''); os._exit(1)"
    subprocess.run([sys.executable, "-c", script], check=False)
    assert sorted(os.listdir(os.path.dirname(path))) == ["d.sock", "d.sock.lock"]
    listening = Listening(path, 0o660, "")
    connect(path).close()
    listening.close()


def test_of_many_that_start_together_one_goes_on(path: str) -> None:
    script = (
        f"import os, sys, sioms.daemon.listening as it\nprint('ready', flush=True)\nsys.stdin.readline()\n"
        f"try: it.Listening({path!r}, 0o660, '')\nexcept OSError: print('refused', flush=True)\n"
        "else: print('listens', flush=True)\nsys.stdin.readline()\nos._exit(0)"
    )
    pipe = subprocess.PIPE
    them = [subprocess.Popen([sys.executable, "-c", script], stdin=pipe, stdout=pipe, text=True) for _ in range(6)]
    said = []
    for phase in range(2):
        for one in them:
            assert one.stdin and one.stdout
            if phase:
                one.stdin.write("go\n")
                one.stdin.flush()
            else:
                one.stdout.readline()
    for one in them:
        assert one.stdout
        said.append(one.stdout.readline())
    for one in them:
        one.communicate("\n")
    assert sorted(said) == ["listens\n"] + ["refused\n"] * 5


def test_what_is_no_socket_stays(path: str) -> None:
    Path(path).write_text("mine")
    refused(path, errno.EEXIST, "exists and is not a socket")
    assert Path(path).read_text() == "mine"


def test_a_daemon_without_a_lock_is_left_alone(path: str) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as other:
        other.bind(path)
        other.listen()
        refused(path, errno.EADDRINUSE, "another daemon answers at")


def test_a_folder_that_others_may_write_to_is_refused(path: str) -> None:
    folder = os.path.dirname(path)
    os.chmod(folder, 0o777)
    refused(path, errno.EPERM, f"{re.escape(folder)}: others may write to it, who could replace the socket in")
    if os.geteuid() == 0:
        os.chown(folder, -1, 4242)  # the group of who knows whom
        os.chmod(folder, 0o775)
        refused(path, errno.EPERM, "others may write to it")
    os.chmod(folder, 0o1777)  # as /tmp, where nobody removes what is another's
    Listening(path, 0o660, "").close()


def test_a_folder_that_somebody_else_may_put_away_is_refused(path: str) -> None:
    inner = os.path.join(os.path.dirname(path), "inner")
    os.mkdir(inner)
    os.chmod(os.path.dirname(path), 0o777)
    refused(
        os.path.join(inner, "d.sock"),
        errno.EPERM,
        f"{re.escape(os.path.dirname(path))}: others may write to it",
    )


@as_root
def test_a_folder_of_somebody_else_is_refused(path: str) -> None:
    os.chown(os.path.dirname(path), NOBODY, -1)
    refused(path, errno.EPERM, f"it belongs to user {NOBODY}")


@pytest.fixture
def strangers(path: str) -> Iterator[str]:
    """Return the path at which nobody's process listens, with a stop-request file beside it."""
    folder = os.path.dirname(path)
    os.chmod(folder, 0o1777)
    script = (
        f"import os, socket, sys\nos.setuid({NOBODY})\ns = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)\n"
        f"s.bind({path!r}); s.listen()\n"
        f"for e in ('.stop', '.stopped'): os.close(os.open({path!r} + e, os.O_CREAT | os.O_RDWR, 0o666))\n"
        "print('ready', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout
        assert other.stdout.readline() == "ready\n"
        yield path
        assert other.stdin
        other.stdin.close()


@as_root
def test_a_strangers_socket_is_not_believed(strangers: str) -> None:
    with pytest.raises(PermissionError, match=f"user {NOBODY} listens there, who is neither you nor root"):
        connect(strangers)
    assert open_stop_request(strangers) is None


@as_root
def test_a_service_is_believed_in_its_own_folder(strangers: str) -> None:
    os.chown(os.path.dirname(strangers), NOBODY, -1)
    connect(strangers).close()
    request = open_stop_request(strangers)
    assert request is not None
    request.close()


@as_root
def test_ones_own_path_is_for_oneself_alone(strangers: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # The folder of a user who has not logged in can be made by anybody, who owns it then.
    folder = os.path.dirname(strangers)
    monkeypatch.setattr("sioms.protocol.socketpath.own_path", lambda: strangers)
    os.chown(folder, NOBODY, -1)
    with pytest.raises(PermissionError, match=f"user {NOBODY} listens there"):
        connect(strangers)
    assert open_stop_request(strangers) is None


def test_a_pipe_in_the_place_of_the_stop_file_holds_nobody_up(path: str) -> None:
    os.mkfifo(path + ".stop")
    os.mkfifo(path + ".stopped")
    assert open_stop_request(path) is None
    with open(os.open(path + ".stop", os.O_RDWR)):
        assert open_stop_request(path) is None
