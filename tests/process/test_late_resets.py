"""A reset that was sent before a stop was acknowledged does not undo it, however late it is served."""

from __future__ import annotations

import errno
import os
import socket
import struct
import time

import pytest
from daemon_rig import Daemon, Waiting, put_in_fault, raises, wait_for

import sioms
from sioms.bridges.leases import Leases
from sioms.bridges.prompt import LATE_NS, SETTLE_NS, Prompt
from sioms.client.cell_verbs import request_stop, stop_call
from sioms.client.channel import Call
from sioms.client.stopping import emergency_stop
from sioms.protocol.flags import PROTOCOL_VERSION, AxisStatus
from sioms.protocol.messages import decode_reply
from sioms.protocol.verbs import EmergencyStop, Hello, Reset


def _latched(node: sioms.AxisNode) -> bool:
    return bool(node.read().status[0] & AxisStatus.EMERGENCY_STOP)


@pytest.mark.parametrize("name", ["mod0.xaxis", ""])
def test_a_reset_that_the_daemon_serves_late_leaves_a_later_stop_on_a_handle(
    daemon: Daemon, cell: sioms.Workcell, name: str
) -> None:
    with (
        daemon.cell("stopper") as other,
        other.open("mod0.xaxis.readonly") as seen,
        other.open("mod0.yaxis.readonly") as beside,
    ):
        beside.emergency_stop()  # of before the reset: that is what it is for
        with daemon.frozen(daemon.pid):
            resetting = Waiting(lambda: cell.reset(name), None)
            wait_for(lambda: _sent(cell), "the reset is sent")
            seen.emergency_stop()
        assert resetting.errno() == errno.EAGAIN and ") stopper on mod0.xaxis" in str(resetting.error)
        assert _latched(seen) and _latched(beside)
        seen_again = daemon.device("mod0")
        os.kill(seen_again["pid"], 9)
        daemon.wait_up("mod0", seen_again["generation"] + 1)
    with cell.open("mod0.xaxis", "rw", timeout=5.0) as axis:
        with raises(errno.EPERM, "emergency stop"):
            axis.move(0.0)
        cell.reset(name)
        axis.move(axis.read().position[0], timeout=1.0)
    cell.reset()


def test_a_reset_that_the_daemon_serves_late_leaves_a_later_stop_past_it(daemon: Daemon, cell: sioms.Workcell) -> None:
    cell.emergency_stop()
    with cell.open("mod0.xaxis.readonly") as seen:
        wait_for(lambda: _latched(seen), "stopped")
        with daemon.frozen(daemon.pid):
            resetting = Waiting(cell.reset, None)
            wait_for(lambda: _sent(cell), "the reset is sent")
            before = os.pread(taken := os.open(daemon.socket + ".stopped", os.O_RDONLY), 8, 0)
            stopping = Waiting(lambda: emergency_stop("again", daemon.socket))
            wait_for(lambda: os.pread(taken, 8, 0) != before, "the drivers have taken it")
        os.close(taken)
        assert stopping.errno() is None
        assert resetting.errno() == errno.EAGAIN
        assert _latched(seen) and cell.status()["stopped_ns"]
        cell.reset()
        wait_for(lambda: not _latched(seen), "reset")


def test_a_stop_that_has_been_reset_does_not_come_again_with_its_message(daemon: Daemon, cell: sioms.Workcell) -> None:
    """Who stops writes a request that drivers obey, and may lose the processor before he tells the daemon."""
    with daemon.cell("stopper") as stopper, cell.open("mod0.xaxis", "rw", timeout=5.0) as axis:
        asked = request_stop(stopper._request, "enough")
        assert asked is not None
        wait_for(asked, "drivers have obeyed")
        cell.reset()
        stopper._channel.call(stop_call("", "enough", False, asked))
        assert not cell.status()["stopped_ns"]
        axis.move(axis.read().position[0], timeout=1.0)


@pytest.mark.parametrize("name", ["mod0.xaxis", ""])
def test_a_reset_that_the_daemon_serves_late_is_refused_after_a_fault(
    daemon: Daemon, cell: sioms.Workcell, name: str
) -> None:
    with daemon.cell("owner") as other, other.open("mod0.xaxis", "rw", timeout=5.0) as axis:
        with daemon.frozen(daemon.pid):
            resetting = Waiting(lambda: cell.reset(name), None)
            wait_for(lambda: _sent(cell), "the reset is sent")
            put_in_fault(axis)
        assert resetting.errno() == errno.EAGAIN
        assert "has come into fault" in str(resetting.error) and "xaxis" in str(resetting.error)
        assert axis.read().status[0] & AxisStatus.FAULT
        cell.reset(name)
        wait_for(lambda: not axis.read().status[0] & AxisStatus.FAULT, "reset by who can have seen it")


def test_the_status_tells_of_a_fault_until_it_is_reset_whoever_does(daemon: Daemon, cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw", timeout=5.0) as axis:
        put_in_fault(axis)
        wait_for(lambda: daemon.device("mod0")["trouble"], "told")
        axis.reset()
        wait_for(lambda: not daemon.device("mod0")["trouble"], "over")


def test_what_one_client_sends_at_once_is_done_in_its_order(daemon: Daemon, cell: sioms.Workcell) -> None:
    """A stop and a reset of one session, in one go: who resets has sent the stop, and knows of it."""
    with daemon.cell("eager") as eager:
        for name in ("mod0.xaxis", ""):
            calls = [Call("at once", each) for each in (EmergencyStop(name, "", False, 0), Reset(name))]
            with daemon.frozen(daemon.pid):
                numbers = [eager._channel.send(call) for call in calls]
            for number, call in zip(numbers, calls, strict=True):
                eager._channel.wait(number, call)
            with cell.open("mod0.xaxis", "rw", timeout=2.0) as axis:
                axis.move(axis.read().position[0], timeout=1.0)


def test_what_was_sent_before_the_daemon_took_the_connection_is_as_old_as_can_be(
    daemon: Daemon, cell: sioms.Workcell
) -> None:
    """The kernel stamps from then on only; unstamped packets come with the time at which they are received."""
    with cell.open("mod0.xaxis.readonly") as seen, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as raw:
        with daemon.frozen(daemon.pid):
            raw.connect(daemon.socket)
            raw.send(Hello(PROTOCOL_VERSION, "raw").packed(1))
            raw.send(Reset("mod0.xaxis").packed(2))
            seen.emergency_stop()
        raw.settimeout(10.0)
        answers = [decode_reply(raw.recv(1 << 16)) for _ in range(2)]
        assert [answer[2] for answer in answers] == [0, errno.EAGAIN]
        assert _latched(seen)


def _sent(cell: sioms.Workcell) -> bool:
    """Whether something lies in a session's socket that the daemon has not received."""
    from fcntl import ioctl
    from termios import TIOCOUTQ

    return struct.unpack("i", ioctl(cell._channel._sock.fileno(), TIOCOUTQ, bytes(4)))[0] > 0


def test_a_bridge_that_was_held_up_passes_on_no_put_of_before_a_reset(daemon: Daemon, cell: sioms.Workcell) -> None:
    now_ns = [time.monotonic_ns()]
    prompt = Prompt(lambda: now_ns[0], beats=False)
    leases = Leases(prompt, lambda name: daemon.cell(name))
    leases.put("mod0", "eva", 5.0)
    with cell.open("mod0.xaxis.readonly") as seen:
        cell.emergency_stop()
        cell.reset()
        now_ns[0] = time.monotonic_ns()  # it goes on only now
        with prompt.word(), raises(errno.ECANCELED, "sent before the last reset"):
            leases.move("mod0", "eva", "xaxis", 0.05)
        assert not seen.read().in_motion[0]
        for _ in range(2 * SETTLE_NS // LATE_NS):
            now_ns[0] += LATE_NS
            prompt.beat()
        with prompt.word():
            leases.move("mod0", "eva", "xaxis", 0.05)
        wait_for(lambda: seen.read().in_motion[0], "motion")
    leases.put("mod0", "eva", 0.0)
