"""What waits for descriptors takes those whose number select(2) cannot hold."""

import fcntl
import os
import resource
import socket
import time
from collections.abc import Iterator

import pytest

from sioms.descriptors import is_readable, is_writable, readable
from sioms.sdk.connection import Connection
from sioms.sdk.settings import LineSettings

HIGH = 1100
"""More than the 1,024 of select(2)."""


@pytest.fixture(autouse=True)
def many_files() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard < HIGH + 100:
        pytest.skip(f"at most {hard} open files are permitted here")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, HIGH + 100), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    low, write = os.pipe()
    read = fcntl.fcntl(low, fcntl.F_DUPFD_CLOEXEC, HIGH)
    os.close(low)
    yield read, write
    os.close(read)
    os.close(write)


def test_a_high_descriptor_is_waited_for(pipe: tuple[int, int]) -> None:
    read, write = pipe
    assert not is_readable(read) and readable([read], 0.0) == []
    began_s = time.monotonic()
    assert not is_readable(read, 0.0025) and time.monotonic() - began_s >= 0.0025
    os.write(write, b"x")
    assert is_readable(read, None) and readable([read, write], 5.0) == [read]
    assert is_writable(write)


def test_an_end_is_readable() -> None:
    ours, far = socket.socketpair()
    with ours:
        far.close()
        assert readable([ours], 5.0) == [ours]
        child = os.fork()
        if not child:
            os._exit(0)
        process = os.pidfd_open(child)
        assert is_readable(process, 5.0)
        os.waitpid(child, 0)
        os.close(process)


def test_a_closed_one_is_an_error(pipe: tuple[int, int]) -> None:
    closed = os.dup(pipe[0])
    os.close(closed)
    with pytest.raises(OSError, match="Bad file descriptor"):
        is_readable(closed, 5.0)


def test_a_line_connects_over_a_high_descriptor() -> None:
    """The daemon and the processes of many devices permit themselves 65,536 open files."""
    filler = [os.open(os.devnull, os.O_RDONLY)]
    while filler[-1] < HIGH:
        filler.append(os.dup(filler[0]))
    try:
        with socket.create_server(("127.0.0.1", 0)) as server:
            connection = Connection(LineSettings(tcp="{}:{}".format(*server.getsockname())))
            assert connection.fd > HIGH and is_writable(connection.fd, 5.0)
            assert connection.is_connected()
            connection.close()
    finally:
        for fd in filler:
            os.close(fd)
