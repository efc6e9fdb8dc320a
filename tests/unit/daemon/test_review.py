"""A driver process that cannot be started: the fork server has just died, no descriptor is left, or the
one before lives.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
import signal
import socket
import subprocess
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from sioms.daemon.config import Device, DeviceTable
from sioms.daemon.devices import DriverProcess, State
from sioms.daemon.fork_server import ForkServer
from sioms.daemon.loop import Loop
from sioms.daemon.names import DeviceInfo
from sioms.daemon.patience import Patience


class _Owner:
    """Notes who is gone."""

    def __init__(self) -> None:
        self.gone: list[str] = []

    def device_gone(self, device: DriverProcess, reason: str) -> None:
        self.gone.append(reason)

    def stopped_of(self, device: str) -> dict[str, Any]:
        return {}

    def __getattr__(self, name: str) -> Any:
        raise AssertionError(f"{name} is not to be called")


def _device(loop: Loop, fork_server: Any, owner: Any) -> DriverProcess:
    common = msgspec.convert({"driver": "sim-io"}, DeviceTable)
    info = DeviceInfo("io0", "sim-io", (), 100.0, (), 0.1)
    return DriverProcess(
        loop, lambda: fork_server, Device("io0", common, {}), info, [], owner, lambda *_args, **_fields: None, {}
    )


def test_a_start_that_is_refused_at_once_is_a_death_like_any_other() -> None:
    loop = Loop()
    owner: Any = _Owner()
    fork_server = ForkServer(loop, lambda _: None)
    os.kill(fork_server.pid, signal.SIGKILL)
    os.waitpid(fork_server.pid, 0)
    device = _device(loop, fork_server, owner)
    device.start()
    assert device.state is State.RESTARTING and "fork server" in owner.gone[0]
    loop.close()


def test_a_start_without_descriptors_is_a_death_like_any_other(monkeypatch: pytest.MonkeyPatch) -> None:
    loop, owner = Loop(), _Owner()

    def none_left(*_: object) -> None:
        raise OSError(24, "Too many open files")

    device = _device(loop, None, owner)
    monkeypatch.setattr(socket, "socketpair", none_left)
    device.start()
    assert device.state is State.RESTARTING and "Too many open files" in owner.gone[0]
    loop.close()


def test_a_process_whose_descriptors_do_not_reach_the_daemon_is_a_death_like_any_other() -> None:
    loop, owner = Loop(), _Owner()
    spawned: list[Any] = []
    device = _device(loop, SimpleNamespace(spawn=lambda *arguments: spawned.append(arguments[-1])), owner)
    device.start()
    spawned[0](1 << 22, 0, "", [])
    assert device.state is State.RESTARTING and "raise LimitNOFILE" in owner.gone[0]
    device = _device(loop, SimpleNamespace(spawn=lambda *_: None), owner)
    device.info = dataclasses.replace(device.info, blocks=(object(), object()))  # type: ignore[arg-type]
    device.start()
    only = os.open("/dev/null", os.O_RDONLY)
    device._ready([only])
    assert device.state is State.RESTARTING and "pages could not be taken" in owner.gone[1]
    with pytest.raises(OSError):
        os.fstat(only)
    loop.close()


def test_the_next_process_is_forked_when_the_last_one_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Until then it may hold the device."""
    loop, forked = Loop(), []
    device = _device(loop, SimpleNamespace(spawn=lambda *_: forked.append(True)), _Owner())
    monkeypatch.setattr(signal, "pidfd_send_signal", lambda *_: None)  # one that takes long to die
    with subprocess.Popen(["sleep", "100"]) as last:
        device._bury(os.pidfd_open(last.pid))
        device.start()
        assert not forked
        last.kill()
        loop.step()
        assert forked
    loop.close()


def test_the_process_after_one_that_was_stuck_is_not_killed_for_it() -> None:
    """On a busy machine the fork is told late; the daemon looks at what is slow before."""
    loop, owner = Loop(), _Owner()
    forks: list[Any] = []
    device = _device(loop, SimpleNamespace(spawn=lambda *words: forks.append(words[-1])), owner)
    device.start()
    with subprocess.Popen(["sleep", "100"]) as first:
        forks[0](first.pid, 0, "", [os.pidfd_open(first.pid)])
        worked = itertools.count(0, 2)
        device._patience = Patience(first.pid, 1.0, lambda _: float(next(worked)), lambda _: "R")
        device.check(10**9)
    assert "2 s of processor time" in device.reason and len(owner.gone) == 1
    while device.state is not State.STARTING:
        loop.step()
    device.check(3 * 10**9)
    assert device.state is State.STARTING and len(owner.gone) == 1, device.reason
    loop.close()
