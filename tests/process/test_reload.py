"""A reload: all or nothing, in turn, seen by nobody whom it does not concern, and with nothing left of it."""

from __future__ import annotations

import errno
import os
import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from daemon_rig import IO, Daemon, Waiting, axes, daemons, wait_for

SLOW = """
import os, time
from sioms.drivers.sim.io import SimIo
class DRIVER(SimIo):
    @classmethod
    def describe(cls, name, settings):
        here = os.path.dirname(__file__)
        if os.path.exists(here + "/deadly"): os._exit(1)
        if os.path.exists(here + "/wrong"): raise RuntimeError("not to be described")
        open(here + "/asked", "a").close()
        while os.path.exists(here + "/slow"): time.sleep(0.005)
        return super().describe(name, settings)
"""
OWN = '[device.own]\ndriver = "./own.py"\noutputs = 4\n'
TEXT = '[workcell]\nname = "test"\n' + axes("mod0", "xaxis") + OWN


@pytest.fixture(scope="module")
def reloaded() -> Iterator[Daemon]:
    """A daemon with a driver that is as slow, deadly or wrong to describe as files beside it say."""
    with daemons() as start:
        yield start(TEXT, files={"own.py": SLOW})


@pytest.fixture
def daemon(reloaded: Daemon) -> Iterator[Daemon]:
    yield reloaded
    for name in ("slow", "deadly", "wrong", "asked"):
        (reloaded.folder / name).unlink(missing_ok=True)
    reloaded.configure(TEXT)
    with reloaded.cell() as cell:
        cell.reload()


def children(pid: int) -> list[str]:
    """Return the state letters of a process's children."""
    states = []
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        with suppress(OSError):  # it has just been reaped
            states.append(Path(f"/proc/{child}/stat").read_text().rpartition(") ")[2][0])
    return states


def test_reloads_wait_their_turn_and_see_the_newest_file(daemon: Daemon) -> None:
    with daemon.cell("one") as one, daemon.cell("two") as two:
        (daemon.folder / "asked").unlink(missing_ok=True)
        (daemon.folder / "slow").touch()
        daemon.configure(TEXT + '[node.first]\nof = "mod0"\n')
        first = Waiting(one.reload)
        wait_for((daemon.folder / "asked").exists, "the first reload is under way")
        daemon.configure(TEXT + '[node.second]\nof = "mod0"\n')
        second = Waiting(two.reload)
        for _ in range(20):
            daemon.running.signal(signal.SIGHUP)
        wait_for(lambda: any(s[2] for s in two.status()["sessions"] if "two" in s[0]), "the second waits")
        (daemon.folder / "slow").unlink()
        assert first.errno() is None and second.errno() is None
        names = {node.name for node in one.nodes()}
    assert "second" in names and "first" not in names


@pytest.mark.parametrize("how", ["deadly", "wrong", "pipe", "folder", "empty", "date", "alias"])
def test_a_reload_with_anything_wrong_changes_nothing_and_the_next_one_works(daemon: Daemon, how: str) -> None:
    if how in ("deadly", "wrong"):
        (daemon.folder / how).touch()
        daemon.configure(TEXT.replace("outputs = 4", "outputs = 8").replace("xaxis", "zaxis"))
    elif how in ("pipe", "folder"):
        daemon.config.unlink()
        os.mkfifo(daemon.config) if how == "pipe" else daemon.config.mkdir()
    else:
        more = {"empty": "", "date": OWN + "when = 2026-01-01\n", "alias": OWN + '[node.no]\nof = "mod9"\n'}[how]
        daemon.configure(axes("mod0", "zaxis") + more if more else "")
    try:
        with daemon.cell() as cell, cell.open("mod0.xaxis", "rw") as axis:
            before = cell.status()["devices"]
            with pytest.raises(OSError) as refused:
                cell.reload()
            assert refused.value.errno == errno.EINVAL
            assert [d["pid"] for d in cell.status()["devices"]] == [d["pid"] for d in before]
            axis.command(position=0.01)
    finally:
        if how == "folder":
            daemon.config.rmdir()
        daemon.config.unlink(missing_ok=True)


def test_what_has_not_changed_does_not_notice(daemon: Daemon) -> None:
    with daemon.cell() as cell, cell.open("mod0.xaxis", "rw") as axis, cell.open("own", "rw") as own:
        pid = daemon.device("mod0")["pid"]
        axis.command(velocity=0.02)
        page = axis.read()

        def loses_no_tick(grant: str) -> bool:
            before = axis.statistics(1)["skipped"]
            daemon.configure(TEXT.replace("outputs = 4", "outputs = 8") + IO + grant)
            cell.reload()
            return bool(axis.statistics(1)["skipped"] == before)

        grants = [f'[[grant]]\nusers = ["*"]\nnodes = ["io{i}"]\nrights = ["read"]\n' for i in range(10)]
        assert any(loses_no_tick(grant) for grant in grants), "on a machine with too much to do it may, by itself"
        assert daemon.device("mod0")["pid"] == pid and axis.read().tick > page.tick, "the same process and page"
        axis.command(velocity=0.0)
        with pytest.raises(OSError):
            own.statistics(1)


def test_a_changed_driver_file_restarts_its_device_alone(daemon: Daemon) -> None:
    pids = {name: daemon.device(name)["pid"] for name in ("mod0", "own")}
    with daemon.cell() as cell:
        (daemon.folder / "own.py").write_text(SLOW + "# changed, and described as before\n")
        cell.reload()
        wait_for(lambda: daemon.device("own")["pid"] not in (0, pids["own"]), "a new process")
        cell.open("own", "rw").close()
        cell.reload()  # the same file once more
        assert daemon.device("mod0")["pid"] == pids["mod0"]
        assert (
            daemon.device("own")["generation"]
            == daemon.wait_up("own", daemon.device("own")["generation"])["generation"]
        )


def test_nothing_is_left_of_reloads(daemon: Daemon) -> None:
    with daemon.cell() as cell:
        cell.reload()
        descriptors = len(os.listdir(f"/proc/{daemon.pid}/fd"))
        for _ in range(3):
            cell.reload()
        wait_for(lambda: len(children(daemon.pid)) == 1, "one fork server is the only child, dead or alive")
        wait_for(lambda: len(os.listdir(f"/proc/{daemon.pid}/fd")) <= descriptors, "as many descriptors as before")


def test_what_holds_from_the_next_start_on_is_told(daemon: Daemon) -> None:
    daemon.configure(TEXT.replace('name = "test"', 'name = "test"\nsocket_mode = "0600"'))
    with daemon.cell() as cell:
        cell.reload()
    daemon.said('event="not taken up" key=socket_mode')
