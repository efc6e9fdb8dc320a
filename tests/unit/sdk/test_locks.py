"""One driver a port and a network device, on this machine and in a configuration."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from sioms.daemon.names import DeviceInfo, shared_claims
from sioms.sdk import locks
from sioms.sdk.locks import NameLocks, PortLock, claims_of
from sioms.sdk.settings import LineSettings

NAME = f"TCP test-{os.getpid()}:502"


def test_a_network_device_has_one_driver_until_that_ends() -> None:
    first, second = NameLocks([NAME, "serial port /dev/x"], print), NameLocks([NAME], print)
    first.take()
    for _ in range(2):
        with pytest.raises(OSError, match=f"open {NAME}: pid {os.getpid()}") as refused:
            second.take()
        assert refused.value.errno == errno.EBUSY
    first.take()
    first.release()
    second.take()
    second.release()


def test_the_lock_of_a_process_ends_with_it_however_that_ends() -> None:
    script = (
        f"from sioms.sdk.locks import NameLocks; mine = NameLocks([{NAME!r}], print); mine.take(); input(print('held', "
        "flush=True))"
    )
    holder = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert holder.stdout and holder.stdin
    holder.stdout.readline()
    mine = NameLocks([NAME], print)
    with pytest.raises(OSError, match=str(holder.pid)):
        mine.take()
    holder.kill()
    holder.wait()
    mine.take()
    mine.release()
    holder.stdin.close()
    holder.stdout.close()


def test_the_lock_of_a_stranger_is_told_and_not_obeyed(monkeypatch: pytest.MonkeyPatch) -> None:
    first, said = NameLocks([NAME], print), []
    first.take()
    monkeypatch.setattr(locks, "_holder", lambda name: (1, 4321))
    second = NameLocks([NAME], said.append)
    second.take()
    second.take()
    assert len(said) == 1 and "uid 4321" in said[0]
    first.release()


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    monkeypatch.setattr(locks, "_may_use", lambda _port, uid: uid == os.getuid())
    return "/dev/ttyNONE7"


def test_a_lock_file_is_made_and_goes_with_the_port(port: str, tmp_path: Path) -> None:
    lock = PortLock(port, str(tmp_path))
    file = tmp_path / "LCK..ttyNONE7"
    assert file.read_bytes() == b"%10d\n" % os.getpid()
    assert [each.name for each in tmp_path.iterdir()] == [file.name]
    PortLock(port, str(tmp_path)).release()
    assert not file.exists()
    lock.release()


def test_the_lock_file_of_a_living_process_is_heeded_and_that_of_a_dead_one_replaced(
    port: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "LCK..ttyNONE7"
    file.write_text(f"{os.getppid():10d}\n")
    with pytest.raises(OSError, match=f"in use by pid {os.getppid()}") as refused:
        PortLock(port, str(tmp_path))
    assert refused.value.errno == errno.EBUSY
    monkeypatch.setattr(locks, "_may_use", lambda _port, uid: False)
    PortLock(port, str(tmp_path)).release()
    assert file.exists(), "who may not use the port cannot lock it, nor is the file ours to take away"
    for dead in ("  99999999\n", "", "nonsense\n", "-1\n"):
        file.write_text(dead)
        PortLock(port, str(tmp_path))
        assert file.read_bytes() == b"%10d\n" % os.getpid()
        file.unlink()


def test_a_folder_that_may_not_be_written_to_is_no_obstacle(port: str) -> None:
    PortLock(port, "/proc/nowhere").release()


def info(name: str, *claims: str) -> DeviceInfo:
    return DeviceInfo(name, "d", (), 1.0, (), 0.1, claims)


@pytest.mark.parametrize(
    ("first", "second", "clash"),
    [
        ("serial port /dev/ttyS0", "serial port /dev/ttyS0", True),
        ("serial port /dev/ttyS0", "serial port /dev/ttyS1", False),
        ("TCP a:502 unit 1", "TCP a:502 unit 2", False),
        ("TCP a:502 unit 1", "TCP a:502 unit 1", True),
        ("TCP a:502", "TCP a:502 unit 1", True),
        ("TCP a:502 unit 1", "TCP a:502", True),
        ("TCP a:502", "UDP a:502", False),
        ("TCP a:502", "TCP a:5021", False),
    ],
)
def test_two_devices_do_not_share_what_only_one_may_have(first: str, second: str, clash: bool) -> None:
    errors = shared_claims([info("a", first), info("b", second), info("c")])
    assert errors == ([f"[device.b]: {second} is already used by device a; want another"] if clash else [])


def test_a_line_is_claimed_by_what_it_is(tmp_path: Path) -> None:
    link = tmp_path / "by-id"
    link.symlink_to("/dev/ttyUSB3")
    assert claims_of(SimpleNamespace(line=LineSettings(serial=str(link)))) == ["serial port /dev/ttyUSB3"]
    tcp = LineSettings(tcp="Drive:502")
    assert claims_of(SimpleNamespace(line=tcp)) == ["TCP drive:502"]
    axes = [SimpleNamespace(address=1), SimpleNamespace(address=2)]
    assert claims_of(SimpleNamespace(line=tcp, axis=axes)) == ["TCP drive:502 unit 1", "TCP drive:502 unit 2"]
    assert claims_of(SimpleNamespace(line=3)) == [] == claims_of(SimpleNamespace())
