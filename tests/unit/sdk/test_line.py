"""The line: one exchange at a time, stops first, silence after what went wrong. The clock is the test's own."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import pytest

from sioms.sdk.codec import modbus
from sioms.sdk.exchange import DeviceError, Exchange, HookError, LinkError, Pause, Send, Steps
from sioms.sdk.line import ATTEMPTS, Counters, Line, Priority
from sioms.sdk.settings import LineSettings

MS = 1_000_000
GAP_S, RECOVERY_S, TIMEOUT_S = 0.002, 0.05, 0.1


class Wire:
    """The connection's calls on one end of a socket pair; the device is the other end."""

    settings = LineSettings(tcp="127.0.0.1:1")

    def __init__(self) -> None:
        self.ours, self.device = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self.ours.setblocking(False)
        self.device.setblocking(False)

    def write(self, data: bytes) -> None:
        self.ours.sendall(data)

    def read(self) -> bytes:
        try:
            return self.ours.recv(4096)
        except BlockingIOError:
            return b""


class Rig:
    """A line, its device, and a clock."""

    def __init__(self, unsolicited: Any = None) -> None:
        self.wire = Wire()
        self.counters = Counters()
        self.line = Line(self.wire, GAP_S, RECOVERY_S, self.counters, unsolicited)  # type: ignore[arg-type]
        self.now = 1_000 * MS
        self.results: list[tuple[str, Any]] = []

    def submit(self, name: str, steps: Steps, priority: Priority = Priority.POLL) -> None:
        self.line.submit(steps, priority, lambda v, e: self.results.append((name, e or v)), self.now)

    def pass_time(self, ms: float) -> None:
        """Let time pass, with all that falls due in it."""
        end = self.now + int(ms * MS)
        while (due := self.line.deadline_ns) is not None and due <= end:
            self.now = max(self.now, due)
            self.line.advance_time(self.now)
        self.now = end

    def heard(self) -> bytes:
        try:
            return self.wire.device.recv(4096)
        except BlockingIOError:
            return b""

    def answer(self, data: bytes) -> None:
        self.wire.device.sendall(data)
        self.line.receive(self.now)


@pytest.fixture
def rig() -> Iterator[Rig]:
    one = Rig()
    yield one
    one.wire.ours.close()
    one.wire.device.close()


def exchange(data: bytes, repeatable: bool = True) -> Exchange:
    """Ask with some bytes; a good reply is the same in capitals, "!" is a refusal, all else is damage."""

    def want(got: bytes) -> int | None:
        if not data.upper().startswith(got[: len(data)]) and not got.startswith(b"!"):
            raise LinkError(f"garbled {got!r}")
        return 1 if got.startswith(b"!") else len(data)

    def decode(reply: bytes) -> bytes:
        if reply == b"!":
            raise DeviceError(5, "refused")
        return reply

    return Exchange(data, want, decode, TIMEOUT_S, repeatable, f"ask {data!r}")


def ask(*words: bytes, repeatable: bool = True) -> Steps:
    replies = []
    for word in words:
        replies.append((yield exchange(word, repeatable)))
    return b" ".join(replies)


def test_a_reply_cut_anywhere_is_one_reply(rig: Rig) -> None:
    rig.submit("a", ask(b"hello"))
    assert rig.heard() == b"hello"
    for byte in b"HELLO":
        assert rig.results == []
        rig.answer(bytes([byte]))
    assert rig.results == [("a", b"HELLO")] and rig.line.is_free


def test_one_exchange_at_a_time_and_silence_before_each(rig: Rig) -> None:
    rig.submit("a", ask(b"one"))
    rig.submit("b", ask(b"two"))
    assert rig.heard() == b"one"
    rig.pass_time(5)
    assert rig.heard() == b""
    rig.answer(b"ONE")
    assert rig.heard() == b"", "the gap"
    rig.pass_time(GAP_S * 1e3)
    assert rig.heard() == b"two"
    rig.answer(b"TWO")
    assert rig.results == [("a", b"ONE"), ("b", b"TWO")]


def test_a_stop_overtakes_all_that_waits_and_goes_in_between_the_steps_of_another(rig: Rig) -> None:
    rig.submit("poll", ask(b"p1", b"p2"))
    for i in range(5):
        rig.submit(f"act{i}", ask(b"a%d" % i), Priority.ACT)
    rig.submit("stop", ask(b"s1", b"s2"), Priority.STOP)
    order = []
    while not rig.line.is_free:
        word = rig.heard()
        if word:
            order.append(word)
            rig.answer(word.upper())
        else:
            rig.pass_time(1)
    assert order == [b"p1", b"s1", b"s2", b"p2", b"a0", b"a1", b"a2", b"a3", b"a4"]
    assert [name for name, _ in rig.results] == ["stop", "poll", *(f"act{i}" for i in range(5))]
    assert dict(rig.results)["poll"] == b"P1 P2", "who was interrupted gets its own reply"


def test_priorities_in_order(rig: Rig) -> None:
    rig.submit("running", ask(b"x"))
    for name in ("POLL", "OUTPUT", "ACT", "STOP"):
        rig.submit(name, ask(b"x"), Priority[name])
    while not rig.line.is_free:
        if rig.heard():
            rig.answer(b"X")
        else:
            rig.pass_time(1)
    # Polls and outputs take turns: neither may starve the other.
    assert [name for name, _ in rig.results] == ["STOP", "running", "ACT", "POLL", "OUTPUT"]


def test_no_reply_is_repeated_after_the_silence_when_it_may_be(rig: Rig) -> None:
    rig.submit("a", ask(b"hi"))
    assert rig.heard() == b"hi"
    rig.pass_time(TIMEOUT_S * 1e3)
    assert rig.heard() == b"" and rig.counters.timeouts == 1
    rig.pass_time(RECOVERY_S * 1e3)
    assert rig.heard() == b"hi" and rig.counters.repeats == 1
    rig.answer(b"HI")
    assert rig.results == [("a", b"HI")]


def test_what_has_side_effects_is_never_sent_twice(rig: Rig) -> None:
    rig.submit("a", ask(b"go", repeatable=False))
    assert rig.heard() == b"go"
    rig.pass_time(1e3 * (TIMEOUT_S + RECOVERY_S) + 500)
    assert rig.heard() == b"" and rig.counters.repeats == 0
    assert isinstance(rig.results[0][1], LinkError) and "no reply within" in str(rig.results[0][1])


def test_it_gives_up_after_its_attempts(rig: Rig) -> None:
    rig.submit("a", ask(b"hi"))
    sent = 0
    for _ in range(1000):
        sent += rig.heard() == b"hi"
        rig.pass_time(1)
    assert sent == ATTEMPTS and rig.line.is_free
    assert isinstance(rig.results[0][1], LinkError)


def test_a_late_reply_is_never_taken_for_the_next(rig: Rig) -> None:
    rig.submit("a", ask(b"one", repeatable=False))
    rig.submit("b", ask(b"two"))
    rig.pass_time(TIMEOUT_S * 1e3 + 10)
    rig.answer(b"ONE")  # late, in the silence
    rig.pass_time(RECOVERY_S * 1e3 - 1)
    assert rig.heard() == b"one", "the silence begins anew with every byte"
    rig.pass_time(2)
    assert rig.heard() == b"two"
    rig.answer(b"TWO")
    assert [(n, isinstance(v, LinkError)) for n, v in rig.results] == [("a", True), ("b", False)]
    assert rig.counters.noise_bytes == 3


def test_a_garbled_reply_is_repeated_and_its_rest_discarded(rig: Rig) -> None:
    rig.submit("a", ask(b"hi"))
    rig.answer(b"Hx")
    assert rig.counters.garbled == 1
    rig.answer(b"more")
    rig.pass_time(RECOVERY_S * 1e3)
    rig.answer(b"HI")
    assert rig.results == [("a", b"HI")] and rig.counters.noise_bytes == 4


def test_a_refusal_is_final(rig: Rig) -> None:
    rig.submit("a", ask(b"hi"))
    rig.answer(b"!")
    assert isinstance(rig.results[0][1], DeviceError) and rig.counters.refused == 1
    rig.pass_time(1000)
    assert rig.heard() == b"hi", "sent once"


def test_a_hook_may_catch_and_go_on(rig: Rig) -> None:
    def steps() -> Steps:
        try:
            yield exchange(b"hi", False)
        except LinkError:
            yield Send(b"bye", "say bye")
            yield Pause(0.01)
        return "done"

    rig.submit("a", steps())
    rig.pass_time(1e3 * (TIMEOUT_S + RECOVERY_S))
    assert rig.heard() == b"hibye" and rig.results == []
    rig.pass_time(10)
    assert rig.results == [("a", "done")]


def test_abandon_ends_all_jobs_once(rig: Rig) -> None:
    rig.submit("a", ask(b"one", b"more"))
    rig.submit("b", ask(b"two"))
    rig.submit("s", ask(b"stop"), Priority.STOP)
    rig.answer(b"ONE")  # a is suspended for the stop
    rig.line.abandon("unplugged")
    assert sorted(name for name, _ in rig.results) == ["a", "b", "s"]
    assert all(isinstance(v, LinkError) and "unplugged" in str(v) for _, v in rig.results)
    assert rig.line.is_free and rig.line.deadline_ns is None


def test_what_nobody_asked_for_goes_to_who_takes_it() -> None:
    taken: list[bytes] = []
    rig = Rig(lambda data, now: taken.append(data))
    rig.answer(b"sample")
    rig.submit("a", ask(b"hi"))
    rig.pass_time(GAP_S * 1e3)
    rig.answer(b"HIsample")
    assert rig.results == [("a", b"HI")] and taken == [b"sample", b"sample"]
    rig.wire.ours.close()
    rig.wire.device.close()


def test_an_exception_of_a_hook_is_the_drivers_and_what_waits_goes_out(rig: Rig) -> None:
    def broken() -> Steps:
        yield exchange(b"x")
        raise KeyError("a key")

    rig.submit("broken", broken())
    rig.submit("stop", ask(b"s"), Priority.ACT)
    assert rig.heard() == b"x"
    with pytest.raises(HookError, match="broken") as caught:
        rig.answer(b"X")
    assert isinstance(caught.value.__cause__, KeyError)
    rig.pass_time(1e3 * GAP_S)
    assert rig.heard() == b"s"
    rig.answer(b"S")
    assert rig.results == [("stop", b"S")]


# --- what does not belong to a reply --------------------------------------------------------------


class SerialWire(Wire):
    settings = LineSettings(serial="/dev/none", baud=12_000_000)


@pytest.fixture
def serial() -> Iterator[Rig]:
    one = Rig()
    one.wire.ours.close()
    one.wire.device.close()
    one.wire = SerialWire()
    one.told: list[str] = []
    one.line = Line(one.wire, GAP_S, RECOVERY_S, one.counters, told=one.told.append)  # type: ignore[arg-type]
    yield one
    one.wire.ours.close()
    one.wire.device.close()


READ = modbus.RtuUnit(1, modbus.SerialLine(12_000_000)).read_holding(0x0400, 2)
WRITE = modbus.RtuUnit(1, modbus.SerialLine(12_000_000)).write_register(0x10, 7)
GOOD = modbus.frame_rtu(1, bytes.fromhex("03 04 0001 0002"))


def one_step(step: Exchange) -> Steps:
    return (yield step)


@pytest.mark.parametrize("stray", [b"\0", b"\xff", b"\x01", b"\x01\x03", bytes(8)])
@pytest.mark.parametrize("cut", [False, True])
def test_stray_bytes_before_a_reply_with_a_checksum_are_skipped(serial: Rig, stray: bytes, cut: bool) -> None:
    serial.submit("a", one_step(READ))
    assert serial.heard() == READ.data
    data = stray + GOOD
    for piece in [data[i : i + 1] for i in range(len(data))] if cut else [data]:
        serial.answer(piece)
    assert serial.results == [("a", (1, 2))]
    assert serial.counters.garbled == 0 and serial.counters.repeats == 0


@pytest.mark.parametrize(
    "data", [bytes(9) + GOOD, b"\0" + GOOD[:-1] + b"\x55", b"\0" + modbus.frame_rtu(2, GOOD[1:-2])]
)
def test_what_is_no_reply_behind_stray_bytes_is_none(serial: Rig, data: bytes) -> None:
    serial.submit("a", one_step(READ))
    for _ in range(ATTEMPTS):
        assert serial.heard() == READ.data
        serial.answer(data)
        serial.pass_time(1e3 * (READ.timeout_s + RECOVERY_S) + 1)
    assert isinstance(serial.results[0][1], LinkError)


def test_a_damaged_reply_costs_a_pause_and_no_time_out(serial: Rig) -> None:
    """Whatever bit of it is wrong: its beginning may be stray bytes, but then the rest comes at once."""
    for bit in range(8 * len(GOOD)):
        bent = bytearray(GOOD)
        bent[bit // 8] ^= 1 << bit % 8
        serial.results.clear()
        garbled = serial.counters.garbled
        serial.submit("a", one_step(READ))
        serial.pass_time(1e3 * GAP_S)
        assert serial.heard() == READ.data
        serial.answer(bytes(bent))
        serial.pass_time(25 + 1e3 * RECOVERY_S)
        assert serial.counters.garbled == garbled + 1, bit
        assert serial.heard() == READ.data, bit
        serial.answer(GOOD)
        assert serial.results == [("a", (1, 2))], bit


@pytest.mark.parametrize("cut", [False, True])
def test_a_line_that_returns_what_is_sent_is_found_out_and_told_once(serial: Rig, cut: bool) -> None:
    for step, reply, value in ((READ, GOOD, (1, 2)), (WRITE, WRITE.data, None), (READ, GOOD, (1, 2))):
        serial.submit("a", one_step(step))
        serial.pass_time(1e3 * GAP_S)
        assert serial.heard() == step.data
        data = step.data + reply
        for piece in [data[i : i + 1] for i in range(len(data))] if cut else [step.data, reply]:
            assert serial.results == []
            serial.answer(piece)
        assert serial.results == [("a", value)]
        serial.results.clear()
    assert len(serial.told) == 1 and "echo" in serial.told[0]
    # the echo of a write is none of its reply, though they are the same bytes
    serial.submit("a", one_step(WRITE))
    serial.pass_time(1e3 * GAP_S)
    serial.answer(WRITE.data)
    serial.pass_time(3e3 * (WRITE.timeout_s + RECOVERY_S))
    assert isinstance(serial.results[0][1], LinkError)


def test_without_a_checksum_nothing_is_skipped(serial: Rig) -> None:
    serial.submit("a", ask(b"12"))
    serial.answer(b"\x0012")
    serial.pass_time(1e3 * (TIMEOUT_S + RECOVERY_S))
    assert serial.counters.garbled == 1 and not serial.results
