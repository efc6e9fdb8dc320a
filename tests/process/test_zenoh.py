"""A workcell on another machine over Zenoh: certificates, access control, and what a link can do."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import zenoh
from daemon_rig import Client, Daemon, raises, wait_for
from remote_rig import halts_within_the_lease
from zenoh.handlers import Callback

import sioms
from sioms.check.remote import ZenohGateway
from sioms.client.keys import VARIABLE, Folder
from sioms.client.zenoh_keys import ALIVE, DOWN, STOP, UP, config, endpoint
from sioms.client.zenoh_link import ZenohLink
from sioms.gateway import certificates
from sioms.protocol import link
from sioms.protocol.link import Up
from sioms.protocol.verbs import EmergencyStop


@pytest.fixture(scope="module")
def gate(shared_daemon: Daemon) -> Iterator[ZenohGateway]:
    """A gateway to the module's daemon."""
    with ZenohGateway(shared_daemon.socket) as gateway:
        yield gateway


@pytest.fixture
def another(gate: ZenohGateway, tmp_path: Path) -> Folder:
    """Keys of somebody else with a good certificate, whom the gateway lets in as ben."""
    folder = Folder(str(tmp_path / "ben"))
    number = gate.certify(folder, "ben")
    gate.keys.allow(f"ben-{number}", number)
    return folder


def test_the_library_is_the_same(daemon: Daemon, gate: ZenohGateway, cell: sioms.Workcell) -> None:
    with sioms.Workcell(gate.socket, "far") as remote, remote.open("mod0", "rw", lease=2.0) as arm:
        arm.move(0.02 if arm.read().position[0] < 0.01 else 0.0)
        arm.wait_until_idle(5.0)
        with cell.open("mod0.readonly") as seen:
            here, there = seen.read(), arm.read()
        assert there.position == pytest.approx(here.position, abs=1e-3) and there.number >= here.number - 50
        assert abs(there.stamp_ns - here.stamp_ns) < 1e9 and 0 < there.stamp_error_ns < 50_000_000
        with raises(errno.EBUSY, "held by eva@127.0.0.1 through sioms serve (far)"):
            cell.open("mod0", "rw")
        numbers: list[int] = []
        while len(numbers) < 200:
            numbers += [s.number for s in arm.history(numbers[-1] if numbers else arm.read().number)]
            arm.wait_new(numbers[-1] if numbers else 0, 2.0)
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), "nothing is lost"
        remote.emergency_stop_workcell("enough")
        assert "eva@127.0.0.1 through sioms serve" in str(cell.status())
        remote.reset()


@pytest.mark.parametrize("what", ["client killed", "gateway killed", "cut", "stalled"])
def test_whatever_fails_halts_what_was_held_within_the_lease(
    what: str, daemon: Daemon, cell: sioms.Workcell, client: Callable[..., Client]
) -> None:
    halts_within_the_lease(what, ZenohGateway, daemon, cell, client)


_FORKS = """
import os, sys, sioms
cell = sioms.Workcell(sys.argv[1], "parent")
child = os.fork()
if not child:
    try:
        sioms.Workcell(sys.argv[1], "child")
    except OSError as error:
        sys.exit(str(error))
os.waitpid(child, 0)
print(cell.info("mod0").name)
"""


def test_a_forked_child_ends_and_is_told_that_it_has_no_zenoh(daemon: Daemon, gate: ZenohGateway) -> None:
    run = subprocess.run(
        [sys.executable, "-P", "-c", _FORKS, gate.socket], capture_output=True, text=True, timeout=30.0, check=True
    )
    assert "forked from one that had used Zenoh" in run.stderr and run.stdout == "mod0\n"


def _session(gate: ZenohGateway, folder: Folder) -> zenoh.Session:
    connect = {"endpoints": [endpoint("127.0.0.1", gate.port)], "timeout_ms": 2000, "exit_on_failure": True}
    return zenoh.open(config(folder, "connect", mode="client", connect=connect))


def test_a_certificate_speaks_and_hears_only_for_itself(daemon: Daemon, gate: ZenohGateway, another: Folder) -> None:
    """Puts, stops, subscriptions and the end of liveliness under another number come to nothing."""
    heard: list[str] = []
    with (
        sioms.Workcell(gate.socket, "far") as far, far.open("mod1", "rw", lease=2.0) as axis,
        _session(gate, another) as hostile,
    ):  # fmt: skip
        subscribers = [
            hostile.declare_subscriber(
                key,
                Callback(lambda sample: heard.append(str(sample.key_expr)), indirect=False),
                allowed_origin=zenoh.Locality.REMOTE,
            )
            for key in (f"{DOWN}/{gate.number}/*", f"{DOWN}/**", "**", f"{UP}/**")
        ]
        stop = EmergencyStop("", "not mine to say", False, 0).packed(1)
        name = f"{gate.number}/0123456789abcdef"
        for _ in range(20):
            hostile.put(f"{UP}/{name}", link.pack(Up.HELLO, link.VERSION, 1))
            hostile.put(f"{STOP}/{name}", link.pack(Up.PACKET, body=stop))
            hostile.liveliness().declare_token(f"{ALIVE}/{name}").undeclare()
            axis.command(position=axis.read().position[0], replace=True)
        time.sleep(0.2)
        assert not far.status()["stopped_ns"] and not axis.closed
        assert not heard, "nobody hears what is for another"
        assert str(far.status()["sessions"]).count("eva@") == 2, "it, and its way of stops"
        del subscribers


def test_a_frame_that_is_played_again_is_taken_once(daemon: Daemon, gate: ZenohGateway, another: Folder) -> None:
    number = certificates.look_at(Path(another.file("certificate.pem")).read_bytes(), "test").number
    name = f"{number}/00000000000000aa"
    answers: list[int] = []
    with _session(gate, another) as session:
        got = Callback(lambda sample: answers.append(sample.payload.to_bytes()[0]), indirect=False)
        subscriber = session.declare_subscriber(f"{DOWN}/{name}", got)
        time.sleep(0.2)
        frames = [link.pack(Up.HELLO, link.VERSION, 1), link.pack(Up.PING, 0, 2, 0, link.ping(5))]
        for _ in range(10):
            for frame in frames:
                session.put(f"{UP}/{name}", frame, congestion_control=zenoh.CongestionControl.BLOCK)
        wait_for(lambda: link.Down.PONG in answers, "the answer to a ping")
        time.sleep(0.3)
        assert answers.count(link.Down.PONG) == 1
        del subscriber


def test_a_frame_that_is_too_large_never_arrives(daemon: Daemon, gate: ZenohGateway, another: Folder) -> None:
    number = certificates.look_at(Path(another.file("certificate.pem")).read_bytes(), "test").number
    with _session(gate, another) as session:
        session.put(f"{UP}/{number}/00000000000000ab", bytes(4 << 20), congestion_control=zenoh.CongestionControl.BLOCK)
        with sioms.Workcell(gate.socket, "far") as far:
            assert far.nodes()


def test_a_revoked_certificate_is_out_at_once(daemon: Daemon, gate: ZenohGateway, cell: sioms.Workcell) -> None:
    with sioms.Workcell(gate.socket, "far") as far, far.open("mod1", "rw", lease=10.0):
        gate.keys.revoke(gate.name)
        try:
            with cell.open("mod1", "rw", timeout=2.0):
                pass
            with raises(errno.EACCES, "revoked"):
                far.nodes()
            with raises(errno.EACCES, f"sioms key allow NAME {gate.number}"):
                sioms.Workcell(gate.socket)
        finally:
            gate.keys.allow(gate.name, gate.number, ("crew",))
    wait_for(lambda: _lets_in(gate), "the certificate that is allowed again")


def _lets_in(gate: ZenohGateway) -> bool:
    try:
        sioms.Workcell(gate.socket).close()
    except OSError:
        return False
    return True


def test_who_has_no_good_certificate_is_told_why(
    daemon: Daemon, gate: ZenohGateway, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Folder(str(tmp_path / "keys"))
    monkeypatch.setenv(VARIABLE, folder.path)
    with raises(errno.EACCES, "sioms cert request"):
        sioms.Workcell(gate.socket)
    gate.certify(folder, "late", days=0)
    with raises(errno.EKEYEXPIRED, "has expired on"):
        sioms.Workcell(gate.socket)
    other = Folder(str(tmp_path / "other"))
    certificates.new_authority(other, "other", 1)
    signed, _ = certificates.sign(other, certificates.request(folder, "stranger").encode(), (), 1)
    with raises(errno.EINVAL, "another authority has signed it"):
        certificates.install(folder, signed.encode())
    os.unlink(folder.file("authority.pem"))
    certificates.install(folder, signed.encode())
    with raises(errno.EACCES, "the certificate of whoever listens there is not taken"):
        sioms.Workcell(gate.socket)
    Path(folder.file("authority.pem")).write_bytes(Path(gate.authority.file("authority.pem")).read_bytes())
    with raises(errno.EACCES, "does not take your certificate"):
        sioms.Workcell(gate.socket)
    monkeypatch.setenv(VARIABLE, gate.own.path)
    with raises(errno.ECONNREFUSED, "start `sioms serve`"):
        sioms.Workcell("zenoh://127.0.0.1:9")
    with raises(errno.EACCES, "is not taken: Hostname mismatch"):
        sioms.Workcell(f"zenoh://localhost:{gate.port}")


def test_a_link_that_ends_while_it_is_made_is_an_error_and_leaves_nothing(
    gate: ZenohGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ends(self: ZenohLink, key: str, priority: zenoh.Priority) -> zenoh.Publisher:
        raise zenoh.ZError("session closed")

    with monkeypatch.context() as patched:
        patched.setattr(ZenohLink, "_publisher", ends)
        before = len(os.listdir("/proc/self/fd"))
        with raises(errno.EIO, "the connection has ended at once"):
            sioms.Workcell(gate.socket)
        wait_for(lambda: len(os.listdir("/proc/self/fd")) <= before, "its descriptors to be closed")
    made = ZenohLink("test", gate.socket, "127.0.0.1", gate.port, 5.0)
    number = made.fds[0]
    made.close()
    other = os.eventfd(0, os.EFD_NONBLOCK)
    os.dup2(other, number)  # as any file that is opened next
    made._take(SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: b"late")))  # type: ignore[arg-type]
    with raises(errno.EAGAIN, ""):
        os.eventfd_read(other)
    for fd in {other, number}:
        os.close(fd)


def test_a_program_that_closes_nothing_ends_in_order(daemon: Daemon, gate: ZenohGateway) -> None:
    for last in ("", "import gc; del cell; gc.collect()"):
        text = f"import sys, sioms; cell = sioms.Workcell(sys.argv[1]); cell.open('mod0.readonly').subscribe(1)\n{last}"
        done = subprocess.run([sys.executable, "-c", text, gate.socket], capture_output=True, text=True)
        assert done.returncode == 0 and not done.stderr, done.stderr


def test_a_client_that_takes_nothing_is_let_go_and_others_do_not_wait(
    daemon: Daemon, gate: ZenohGateway, client: Callable[..., Client]
) -> None:
    stuck = client(
        gate,
        "node = cell.open('mod0.readonly'); node.subscribe(1)\nprint('ready', flush=True)\nwhile True: time.sleep(1)\n",
    )
    stuck.wait_line("ready")
    os.kill(stuck.pid, signal.SIGSTOP)
    try:
        with sioms.Workcell(gate.socket, "far") as far:
            wait_for(lambda: "victim" not in str(far.status()["sessions"]), "the end of a session that takes nothing")
            assert far.open("mod1", "rw").read()
    finally:
        os.kill(stuck.pid, signal.SIGCONT)
