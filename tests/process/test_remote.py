"""A workcell on another machine: one gateway, the same library and tools, and whatever a link can do."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import resource
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from daemon_rig import Client, Daemon, Waiting, raises, wait_for
from remote_rig import halts_within_the_lease

import sioms
import sioms.aio
from sioms.check.remote import Gateway, Relay, free_ports
from sioms.client.command import command
from sioms.client.keys import Folder
from sioms.gateway.connections import MOST_STRANGERS
from sioms.gateway.inflow import MOST
from sioms.protocol.flags import AxisStatus
from sioms.protocol.link import DEFAULT_LEASE_S


@pytest.fixture(scope="module")
def gate(shared_daemon: Daemon) -> Iterator[Gateway]:
    """A gateway to the module's daemon."""
    with Gateway(shared_daemon.socket) as gateway:
        yield gateway


@pytest.fixture
def remote(daemon: Daemon, gate: Gateway) -> Iterator[sioms.Workcell]:
    """A session through it."""
    with sioms.Workcell(gate.socket, "far") as cell:
        yield cell


def test_the_library_is_the_same_and_others_hear_whose_it_is(remote: sioms.Workcell, cell: sioms.Workcell) -> None:
    with remote.open("mod0", "rw", lease=2.0) as arm:
        start = arm.read()
        for axis in (0, 1):
            arm.move(0.02 if start.position[axis] < 0.01 else 0.0, axis)
        arm.wait_until_idle(5.0)
        with cell.open("mod0.readonly") as seen:
            here, there = seen.read(), arm.read()
            assert there.position == pytest.approx(here.position, abs=1e-3) and there.number > start.number
        assert abs(there.stamp_ns - here.stamp_ns) < 1e9 and there.stamp_error_ns < 50_000_000
        assert abs(there.utc.ns - time.time_ns()) < 2e9 and here.stamp_error_ns == 0
        with raises(errno.EBUSY, "held by eva@127.0.0.1 through sioms serve (far)"):
            cell.open("mod0", "rw")
        with raises(errno.ENOENT, "no such node", "mod0"):
            remote.open("mod00")
        with raises(errno.EINVAL, "lease"):
            remote.open("mod1", "rw", lease=60.0)
        position = arm.read().position[0]
        for step in range(20):
            arm.command(position=position + 0.01, replace=True)
            arm.stop()
            arm.command(position=position + 0.01, synch=True)
            assert arm.read().buffered[0] == 1, "a reading after an acknowledgement shows it"
            arm.flush()
            assert arm.read().buffered[0] == 0, step
        assert len(arm.history(arm.read().number - 10)) >= 5
        marker = remote.reserve_marker()
        arm.command(position=position, signal=marker, replace=True)
        assert abs(marker.wait(5.0) - time.monotonic_ns()) < 2e9
    with cell.open("mod0", "rw", timeout=2.0):
        pass


def test_a_subscriber_gets_every_publication(remote: sioms.Workcell) -> None:
    with remote.open("mod0.readonly") as seen:
        first = seen.read().number
        numbers = []
        while len(numbers) < 300:
            numbers += [s.number for s in seen.history(numbers[-1] if numbers else first)]
            seen.wait_new(numbers[-1] if numbers else first, 2.0)
        assert numbers == list(range(first + 1, first + 1 + len(numbers)))


def test_every_call_of_a_session_renews_what_it_holds(remote: sioms.Workcell) -> None:
    def goes_on() -> bool:
        return bool(axis.read().commanded_velocity[0] > 0.04)

    lease_s = 1.0  # on a busy machine the default of 0.2 s is lost in good faith
    with remote.open("force0") as force, remote.open("mod1", "rw", lease=lease_s) as axis:
        axis.command(velocity=0.05)
        with raises(errno.ETIMEDOUT):  # a wait at the daemon
            remote.wait_marker(remote.reserve_marker(), 1.5 * lease_s)
        assert goes_on()
        end_s = time.monotonic() + 1.5 * lease_s
        while time.monotonic() < end_s:  # readings of another node
            force.wait_new(force.read().number, 1.0)
        assert goes_on()
        for ask in (remote.status, force.statistics):  # answered at once: nobody waits
            end_s = time.monotonic() + 1.5 * lease_s
            while time.monotonic() < end_s:
                ask()
                time.sleep(0.01)
            assert goes_on()
        axis.stop()
    with remote.open("force0"), raises(errno.ETIMEDOUT):  # with nothing to renew any more
        remote.wait_marker(remote.reserve_marker(), 2 * DEFAULT_LEASE_S)


def test_the_asyncio_face_and_its_loop_keep_what_is_held(daemon: Daemon, gate: Gateway) -> None:
    async def go() -> None:
        async with await sioms.aio.connect(gate.socket) as cell, await cell.open("mod1", "rw") as axis:
            await axis.command(velocity=0.05)
            await asyncio.sleep(3 * DEFAULT_LEASE_S)
            assert axis.read().commanded_velocity[0] > 0.04, "the loop runs"
            time.sleep(2 * DEFAULT_LEASE_S)  # and now it hangs
            with raises(errno.ETIMEDOUT, "lease"):
                await axis.command(velocity=0.05)

    asyncio.run(go())


def test_the_pipe_tools_and_the_front_door_are_the_same(daemon: Daemon, gate: Gateway) -> None:
    environment = {**os.environ, "SIOMS_CELL": gate.socket}
    tools = Path(os.sys.executable).parent  # type: ignore[attr-defined]

    def run(*words: str, text: str = "") -> str:
        done = subprocess.run(
            [tools / words[0], *words[1:]], env=environment, input=text, capture_output=True, text=True
        )
        assert not done.returncode, done.stderr
        return done.stdout

    run("devout", "mod1", "0.03")
    assert run("devin", "mod1").split()[0] == "0"
    assert "mod1" in run("sioms", "list")
    run("sdev", "-e")
    assert "eva@127.0.0.1 through sioms serve" in run("sioms", "status")
    run("sioms", "reset")


@pytest.mark.parametrize("what", ["client killed", "client hung", "gateway killed", "gateway hung", "cut", "stalled"])
def test_whatever_fails_halts_what_was_held_within_the_lease(
    what: str, daemon: Daemon, cell: sioms.Workcell, client: Callable[..., Client]
) -> None:
    halts_within_the_lease(what, Gateway, daemon, cell, client)


def test_a_link_that_delays_serves_and_one_that_doubles_ends_with_a_sentence(daemon: Daemon, gate: Gateway) -> None:
    with Relay(gate.port) as relay:
        relay.delay_s = 0.02
        with sioms.Workcell(gate.trusted(relay.port), "slow") as cell, cell.open("mod1", "rw") as axis:
            for _ in range(5):
                axis.move(axis.read().position[0])
            assert axis.read().stamp_error_ns > 10_000_000, "what is not known of the clocks is said"
            relay.doubled = True
            with pytest.raises(OSError, match=r"lost|does not answer") as refused:  # half a frame twice has no end
                for _ in range(100):
                    axis.move(0.0, replace=True)
            assert refused.value.errno in (errno.EIO, errno.ETIMEDOUT)


@contextlib.contextmanager
def behind_a_relay(gate: Gateway) -> Iterator[tuple[Relay, sioms.Workcell, sioms.AxisNode]]:
    """A session whose frames a relay may hold up, and an axis that it holds."""
    with (
        Relay(gate.port) as relay,
        sioms.Workcell(gate.trusted(relay.port), "far") as far,
        far.open("mod1", "rw", lease=10.0) as axis,
    ):
        yield relay, far, axis


@pytest.mark.parametrize("node", ["mod1", ""])
def test_what_was_under_way_at_a_stop_and_its_reset_is_not_carried_out(
    daemon: Daemon, gate: Gateway, cell: sioms.Workcell, node: str
) -> None:
    with behind_a_relay(gate) as (relay, far, axis):
        axis.command(velocity=0.01)
        relay.treat(stalled=True)
        writing = Waiting(lambda: axis.command(velocity=0.05))
        time.sleep(0.1)
        cell.emergency_stop(node)
        cell.reset(node)
        relay.treat()
        assert writing.errno() == errno.ECANCELED
        for _ in range(20):
            far.emergency_stop(node)
            far.reset(node)
            axis.command(velocity=0.01)  # who knows of the reset is not refused


WAYS = ["of the cell", "of the node", "by a reader", "of the workcell"]


def resets(far: sioms.Workcell, axis: sioms.AxisNode, reader: sioms.AxisNode) -> dict[str, Callable[[], object]]:
    """Return the ways to reset mod1 from another machine."""
    ways = (lambda: far.reset("mod1"), axis.reset, reader.reset, far.reset)
    return dict(zip(WAYS, ways, strict=True))


@pytest.mark.parametrize("again", ["by the daemon", "on a handle"])
@pytest.mark.parametrize("way", WAYS)
def test_a_reset_that_was_under_way_leaves_a_later_stop(
    daemon: Daemon, gate: Gateway, cell: sioms.Workcell, way: str, again: str
) -> None:
    with (
        behind_a_relay(gate) as (relay, far, axis),
        far.open("mod1.readonly") as reader,
        cell.open("mod1.readonly") as seen,
    ):
        reset = resets(far, axis, reader)[way]
        name = "" if way == "of the workcell" else "mod1"
        cell.emergency_stop(name)
        wait_for(lambda: axis.read().status[0] & AxisStatus.EMERGENCY_STOP, "the client to see the first stop")
        relay.treat(stalled=True)
        resetting = Waiting(reset)
        time.sleep(0.1)
        if again == "on a handle":
            seen.emergency_stop()
        else:
            cell.emergency_stop(name)
        relay.treat()
        assert resetting.errno() == errno.EAGAIN
        assert seen.read().status[0] & AxisStatus.EMERGENCY_STOP
        reset()
        wait_for(lambda: not seen.read().status[0] & AxisStatus.EMERGENCY_STOP, "reset")


@pytest.mark.parametrize("way", WAYS)
def test_a_reset_of_who_has_not_heard_since_a_fault_is_refused(
    daemon: Daemon, gate: Gateway, cell: sioms.Workcell, way: str
) -> None:
    """It would clear nothing; the refusal tells why, and whoever resets again then knows of the fault."""
    with (
        behind_a_relay(gate) as (relay, far, axis),
        far.open("mod1.readonly") as reader,
        cell.open("mod1.readonly") as seen,
    ):
        reset = resets(far, axis, reader)[way]
        axis.command(velocity=1.0, max_force=1e-3)
        relay.treat(stalled=True)
        wait_for(lambda: seen.read().status[0] & AxisStatus.FAULT, "in fault")
        resetting = Waiting(reset)
        time.sleep(0.1)
        relay.treat()
        assert resetting.errno() == errno.EAGAIN
        assert seen.read().status[0] & AxisStatus.FAULT
        reset()
        wait_for(lambda: not seen.read().status[0] & AxisStatus.FAULT, "reset")


def test_a_revoked_key_is_out_at_once(daemon: Daemon, gate: Gateway, cell: sioms.Workcell) -> None:
    with sioms.Workcell(gate.socket, "far") as far, far.open("mod1", "rw", lease=10.0):
        gate.keys.revoke(gate.name)
        try:
            with cell.open("mod1", "rw", timeout=2.0):
                pass
            with raises(errno.EACCES, "revoked"):
                far.nodes()
            with raises(errno.EACCES, "does not let your key in", "sioms key allow"):
                sioms.Workcell(gate.socket)
        finally:
            own = gate.own.own()
            assert own is not None
            gate.keys.allow(gate.name, own.public, ("crew",))
            time.sleep(0.3)


def test_who_was_halted_since_the_gateway_was_stopped_is_told_so(gate: Gateway, cell: sioms.Workcell) -> None:
    """The driver's last word lies at the gateway behind what the client has sent meanwhile."""
    with sioms.Workcell(gate.socket, "far") as far, far.open("mod1", "rw", lease=10.0) as arm:
        os.kill(gate.process.pid, signal.SIGSTOP)
        try:
            for _ in range(3):
                arm.keepalive()
                time.sleep(0.05)
            with cell.open("mod1", "rw", timeout=5.0):
                pass
        finally:
            os.kill(gate.process.pid, signal.SIGCONT)
        with raises(errno.ETIMEDOUT, "its gateway was stopped"):
            while True:
                arm.stop()


def test_a_message_without_an_end_ends_its_connection_alone(remote: sioms.Workcell, gate: Gateway) -> None:
    context: Any = zmq.Context()
    dealer, own = context.socket(zmq.DEALER), gate.own.own()
    assert own is not None
    dealer.curve_publickey, dealer.curve_secretkey = own.public.encode(), own.secret.encode()
    dealer.curve_serverkey = gate.public.encode()
    dealer.setsockopt(zmq.RECONNECT_IVL, -1)
    monitor = dealer.get_monitor_socket(zmq.EVENT_DISCONNECTED)
    dealer.connect(f"tcp://127.0.0.1:{gate.port}")
    part = bytes(60_000)
    for _ in range(3 * MOST // len(part)):
        dealer.send(part, zmq.SNDMORE)
    dealer.send(b"")
    assert monitor.poll(10_000), "the gateway ends the connection"
    assert remote.status()["workcell"] == "test"
    context.destroy(0)


def test_a_crowd_of_strangers_keeps_nobody_out(remote: sioms.Workcell, gate: Gateway) -> None:
    files = Path(f"/proc/{gate.process.pid}/fd")

    def count() -> int:
        return len(list(files.iterdir()))

    before = resource.prlimit(gate.process.pid, resource.RLIMIT_NOFILE)
    with remote.open("mod0.xaxis", "rw", lease=10.0) as axis, contextlib.ExitStack() as crowd:
        resource.prlimit(gate.process.pid, resource.RLIMIT_NOFILE, (count() + MOST_STRANGERS + 50, before[1]))
        try:
            for _ in range(MOST_STRANGERS + 200):
                crowd.enter_context(socket.create_connection(("127.0.0.1", gate.port), 5.0))
            wait_for(lambda: count() < MOST_STRANGERS + 40, "those above the bound to be turned away")
            axis.write(command(0, velocity=0.0))
            with sioms.Workcell(gate.socket, "new") as another:
                assert another.status()["devices"]
        finally:
            resource.prlimit(gate.process.pid, resource.RLIMIT_NOFILE, before)


def test_wrong_addresses_and_keys_are_told_in_a_sentence(
    daemon: Daemon, gate: Gateway, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with raises(errno.EINVAL, "want zmq://HOST:PORT"):
        sioms.Workcell("tcp://127.0.0.1:5")
    gate.own.trust("no-such-host.invalid:5770", gate.public)
    with raises(errno.EHOSTUNREACH, "no-such-host.invalid", "not known"):
        sioms.Workcell("zmq://no-such-host.invalid:5770")
    with raises(errno.ECONNREFUSED, "sioms serve"):
        sioms.Workcell(gate.trusted(free_ports()))
    with raises(errno.EACCES, "sioms key trust"):
        sioms.Workcell("zmq://localhost:5770")
    monkeypatch.setenv("SIOMS_KEYS", str(tmp_path / "other"))
    with raises(errno.EACCES, "sioms key new"):
        sioms.Workcell(gate.socket)
    other = Folder()
    other.new("mallory")
    other.trust(f"127.0.0.1:{gate.port}", gate.public)
    with raises(errno.EACCES, "does not let your key in"):
        sioms.Workcell(gate.socket)
    other.distrust(f"127.0.0.1:{gate.port}")
    mallory = other.own()
    assert mallory is not None
    other.trust(f"127.0.0.1:{gate.port}", mallory.public)
    with raises(errno.EACCES, "another key than the one trusted here"):
        sioms.Workcell(gate.socket)


def test_sessions_come_and_go_and_leave_nothing(daemon: Daemon, gate: Gateway) -> None:
    def descriptors(pid: int) -> int:
        return len(os.listdir(f"/proc/{pid}/fd"))

    def come_and_go() -> None:
        with sioms.Workcell(gate.socket) as cell, cell.open("mod1", "rw") as axis:
            axis.read()

    come_and_go()
    time.sleep(0.3)
    before = descriptors(gate.process.pid), descriptors(os.getpid())
    for _ in range(30):
        come_and_go()
    wait_for(lambda: descriptors(gate.process.pid) <= before[0] + 2, "the gateway has let go", 5.0)
    wait_for(lambda: descriptors(os.getpid()) <= before[1] + 6, "we have let go", 5.0)


def test_a_forked_child_has_a_session_of_its_own_or_none(remote: sioms.Workcell, gate: Gateway) -> None:
    remote.info("mod0")
    for opens in (True, False):
        child = os.fork()
        if not child:
            code = 30
            try:
                with sioms.Workcell(gate.socket, "child") if opens else remote as cell:
                    code = 10 + (cell.info("mod0").name == "mod0")
            except OSError as error:
                code = 20 + ("forked child" in str(error))
            finally:
                os._exit(code)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == (11 if opens else 21)
        assert remote.info("mod0").name == "mod0"
