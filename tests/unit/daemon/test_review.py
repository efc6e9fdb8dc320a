"""A driver process that cannot be started because the nursery has just died."""

from __future__ import annotations

import os
import signal
from typing import Any

import msgspec

from sioms.daemon.config import Device, DeviceTable
from sioms.daemon.devices import DriverProcess, State
from sioms.daemon.loop import Loop
from sioms.daemon.names import DeviceInfo
from sioms.daemon.nursery import Nursery


class _Owner:
    """Notes who is gone."""

    def __init__(self) -> None:
        self.gone: list[str] = []

    def device_gone(self, device: DriverProcess, reason: str) -> None:
        self.gone.append(reason)

    def stopped_of(self, device: str) -> list[Any]:
        return []

    def __getattr__(self, name: str) -> Any:
        raise AssertionError(f"{name} is not to be called")


def test_a_start_that_is_refused_at_once_is_a_death_like_any_other() -> None:
    loop = Loop()
    owner: Any = _Owner()
    nursery = Nursery(loop, lambda _: None)
    os.kill(nursery.pid, signal.SIGKILL)
    os.waitpid(nursery.pid, 0)
    common = msgspec.convert({"driver": "sim-io"}, DeviceTable)
    info = DeviceInfo("io0", "sim-io", (), 100.0, (), 0.1)
    device = DriverProcess(
        loop, lambda: nursery, Device("io0", common, {}), info, [], owner, lambda *_args, **_fields: None, {}
    )
    device.start()
    assert device.state is State.RESTARTING and "nursery" in owner.gone[0]
    loop.close()
