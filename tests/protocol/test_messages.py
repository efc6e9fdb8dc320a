"""Messages on the sockets: golden bytes, so that an old client and a new daemon go on understanding each other."""

from __future__ import annotations

import errno
import math
import random
import zlib

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.protocol.driver_verbs import (
    FROM_DRIVER,
    TO_DRIVER,
    TO_FORK_SERVER,
    AlarmChanged,
    Attach,
    Describe,
    Detach,
    Detached,
    DriverVerb,
    ForkServerVerb,
    Held,
    HeldSilent,
    Input,
    InUse,
    LinkChanged,
    LogLine,
    MarkerSignalled,
    NodeReset,
    NodeStop,
    Ready,
    Shutdown,
    Spawn,
    StopChanged,
    Stopped,
    StopsShown,
)  # fmt: skip
from sioms.protocol.flags import (
    Access,
    AnalogStatus,
    AxisStatus,
    ControlMode,
    NodeClass,
    PageState,
    Request,
    Right,
    WriteFlag,
)  # fmt: skip
from sioms.protocol.messages import (
    MAX_PACKET,
    MAX_UNPACKED,
    MAX_VALUES,
    ClientVerb,
    HandleVerb,
    MalformedMessage,
    decode,
    decode_reply,
    encode,
    refusal,
    reply,
    short_reply,
    value_of,
)  # fmt: skip
from sioms.protocol.records import ANALOG_WRITE, AXIS_WRITE, BINARY_WRITE
from sioms.protocol.text import MAX_TEXT
from sioms.protocol.verbs import (
    FROM_CLIENT,
    ON_HANDLE,
    Acknowledge,
    Alarms,
    Cancel,
    CancelOnHandle,
    Close,
    EmergencyStop,
    FreeMarker,
    Heard,
    Hello,
    Info,
    Ioctl,
    Journal,
    Keepalive,
    List,
    Message,
    Open,
    Part,
    Passed,
    Reload,
    Report,
    Represent,
    ReserveMarker,
    Reset,
    Said,
    SignalMarker,
    Status,
    Subscribe,
    Supervise,
    TellAlarm,
    WaitMarker,
    Write,
    take,
)  # fmt: skip
from sioms.protocol.wire import MAX_DEPTH

GOLDEN = [
    (encode(ClientVerb.HELLO, 1, 1, "eva"), "94010101a3657661"),
    (encode(ClientVerb.OPEN, 2, "mod0", 3, 0.5, 0.0), "960202a46d6f643003cb3fe0000000000000cb0000000000000000"),
    (encode(ClientVerb.OPEN, 2, "mod0", 1, None, 0.0), "960202a46d6f643001c0cb0000000000000000"),
    (encode(ClientVerb.CLOSE, 3, 300), "930303cd012c"),
    (encode(ClientVerb.RESERVE_MARKER, 4, 2, False), "940a0402c2"),
    (encode(ClientVerb.SIGNAL_MARKER, 5, 1 << 49), "930c05cf0002000000000000"),
    (encode(ClientVerb.EMERGENCY_STOP, 6, "", "why", False), "951406a0a3776879c2"),
    (encode(HandleVerb.WRITE, 1, 0, 0.0, b"\x01\x02"), "95010100cb0000000000000000c4020102"),
    (encode(HandleVerb.WRITE, 1, 1, None, None), "95010101c0c0"),
    (encode(HandleVerb.IOCTL, 2, 23, {"position_max": 0.2}, 0.0),
     "9502021781ac706f736974696f6e5f6d6178cb3fc999999999999acb0000000000000000"),
    (encode(HandleVerb.SUBSCRIBE, 3, -1), "930303ff"),
    (encode(HandleVerb.KEEPALIVE, 0), "920400"),
    (encode(DriverVerb.DETACHED, 0, 7), "93150007"),
    (reply(9), "940009" + "00c0"),
    (reply(9, [1, 2]), "94000900920102"),
    (refusal(9, 16, "held"), "94000910a468656c64"),
    (reply(9, None, 1 << 40), "96000900c0c2cf0000010000000000"),
    (refusal(9, 16, "held", 1 << 40), "96000910a468656c64c2cf0000010000000000"),
]  # fmt: skip

SOCKETS = (FROM_CLIENT, ON_HANDLE, TO_DRIVER, FROM_DRIVER, TO_FORK_SERVER)
RECORDED: list[tuple[Message, str]] = [
    (Hello(2, "eva"), "94010502a3657661"),
    (Represent("kate", "lab2", ["ops"]), "950705a46b617465a46c61623291a36f7073"),
    (Open("mod0", 3, None, 0.25), "960205a46d6f643003c0cb3fd0000000000000"),
    (Close(300), "930305cd012c"),
    (List(), "920405"),
    (Info("mod0.xaxis"), "930505aa6d6f64302e7861786973"),
    (Status(), "920605"),
    (Journal("mod0"), "930805a46d6f6430"),
    (Report("info", "well"), "940905a4696e666fa477656c6c"),
    (Alarms(), "921705"),
    (Acknowledge("mod0", "seen"), "941805a46d6f6430a47365656e"),
    (ReserveMarker(2, True), "940a0502c3"),
    (FreeMarker(562949953421312), "930b05cf0002000000000000"),
    (SignalMarker(7), "930c0507"),
    (WaitMarker(7, 1.5), "940d0507cb3ff8000000000000"),
    (EmergencyStop("", "why", False, 0), "961405a0a3776879c200"),
    (Supervise(0.5), "931905cb3fe0000000000000"),
    (TellAlarm("mod0", "drift", 1, "why"), "961a05a46d6f6430a5647269667401a3776879"),
    (Reset("mod0"), "931505a46d6f6430"),
    (Said(7), "931b0507"),
    (Reload(), "921605"),
    (Cancel(5), "931e0505"),
    (Write(1, 0.5, b"\x01\x02"), "95010501cb3fe0000000000000c4020102"),
    (
        Ioctl(23, {"position_max": [0.2, None]}, 0.0),
        "9502051781ac706f736974696f6e5f6d617892cb3fc999999999999ac0cb0000000000000000",
    ),
    (Subscribe(-1), "930305ff"),
    (Keepalive(), "920405"),
    (Heard(7), "93070507"),
    (Passed(7, b"\x92\x04\x00"), "94080507c403920400"),
    (CancelOnHandle(5), "93050505"),
    (Part(9, b"\x03"), "94060509c40103"),
    (
        Attach(7, 0, [0, 1], -1, 3, True, 15, 250000000, "eva (pid 5)", 1001, [64, 16], "mod0"),
        "9e01050700920001ff03c30fce0ee6b280ab6576612028706964203529cd03e9924010a46d6f6430",
    ),
    (Detach(7, 110, "late"), "950205076ea46c617465"),
    (StopChanged(), "920305"),
    (Shutdown(), "920405"),
    (Input("io0", [0], 3), "950505a3696f30910003"),
    (Held("mod0", [["x", "m"]]), "940905a46d6f64309192a178a16d"),
    (NodeStop(0, [0, 1], -1, "eva", 2, 9), "98060500920001ffa36576610209"),
    (NodeReset(0, [1], 4, "eva", 2, 7, 6), "99070500910104a3657661020706"),
    (InUse(True), "930805c3"),
    (Ready(2), "93140502"),
    (Detached(7), "93150507"),
    (MarkerSignalled(9), "93160509"),
    (Stopped("io0.bit3"), "931705a8696f302e62697433"),
    (StopsShown(5), "931c0505"),
    (LinkChanged(2, "unplugged"), "94180502a9756e706c7567676564"),
    (AlarmChanged(0, 1, -1, "fault", 2, "stalled", 9), "991a050001ffa56661756c7402a77374616c6c656409"),
    (HeldSilent("mod0", "mute"), "941b05a46d6f6430a46d757465"),
    (LogLine("error", "no"), "941905a56572726f72a26e6f"),
    (
        Describe("mod0", "sim-axis", {"a": [1, True]}, "/etc"),
        "960105a46d6f6430a873696d2d6178697381a1619201c3a42f657463",
    ),
    (Spawn("mod0", "sim-axis", {}, 3, {"user": "eva"}), "970205a46d6f6430a873696d2d61786973800381a475736572a3657661"),
]
"""Every verb with number 5, as it was sent before there was a table of verbs."""


@pytest.mark.parametrize(("message", "packet"), RECORDED, ids=[type(m).__name__ for m, _ in RECORDED])
def test_every_verb_is_on_the_wire_as_ever(message: Message, packet: str) -> None:
    assert message.packed(5).hex() == packet
    (socket,) = (socket for socket in SOCKETS if type(message) in socket.values())
    number, taken = take(bytes.fromhex(packet), socket)
    assert (number, type(taken)) == (5, type(message))
    assert list(taken) == list(message)


def test_no_verb_is_left_out() -> None:
    kinds = [kind for socket in SOCKETS for kind in socket.values()]
    assert {type(message) for message, _ in RECORDED} == {*kinds}
    for verbs, sockets in (
        (ClientVerb, [FROM_CLIENT]),
        (HandleVerb, [ON_HANDLE]),
        (DriverVerb, [TO_DRIVER, FROM_DRIVER]),
        (ForkServerVerb, [TO_FORK_SERVER]),
    ):
        assert sorted(verb for socket in sockets for verb in socket) == sorted(verbs)


def test_a_message_is_taken_in_its_states_only() -> None:
    ready = Ready(1).packed()
    assert take(ready, FROM_DRIVER, state="starting") == (0, Ready(1))
    with pytest.raises(MalformedMessage, match="Ready while up; want it while starting or ending"):
        take(ready, FROM_DRIVER, state="up")


@pytest.mark.parametrize("number", [0, 3])
def test_a_request_has_a_number_of_its_own(number: int) -> None:
    with pytest.raises(MalformedMessage, match=f"message number {number} is zero or in use"):
        take(Status().packed(number), FROM_CLIENT, pending={3})
    assert take(Keepalive().packed(number), ON_HANDLE, pending={3}) == (number, Keepalive())


@pytest.mark.parametrize(("packet", "golden"), GOLDEN, ids=[g for _, g in GOLDEN])
def test_golden_bytes(packet: bytes, golden: str) -> None:
    assert packet.hex() == golden
    assert decode(packet) == msgpack.unpackb(packet)


@pytest.mark.parametrize(("packet", "golden"), GOLDEN, ids=[g for _, g in GOLDEN])
def test_cut_anywhere_or_followed_by_more_is_no_message(packet: bytes, golden: str) -> None:
    for cut in range(len(packet)):
        with pytest.raises(MalformedMessage):
            decode(packet[:cut])
    for more in (b"\0", b"\xc0", packet):
        with pytest.raises(MalformedMessage):
            decode(packet + more)


@pytest.mark.parametrize(
    "packet",
    [
        b"", b"\x90", b"\x91\x01", b"\xc1", b"\x80", b"\x82\x01\x02\x03\x04", b"\xa3abc", b"\xc0", b"\x92\xc0\x01",
        encode(1.0, 1), encode(True, 1), encode(1, True), encode(-1, 1), encode(256, 1), encode(1, -1), encode(1, 1 << 53),  # noqa: E501
        b"\x93\x01\x02\xa2\xff\xfe", b"\x92\x01\xcf\xff\xff\xff\xff\xff\xff\xff\xff", b"\xdc\xff\xff", b"\x91" * 5000,
        b"\x93\x01\x01\x81\x91\x01\x01", b"\x93\x01\x01\x82\xc4\x01a\x01\xc4",
    ],
    ids=lambda p: p[:10].hex() or "empty",
)  # fmt: skip
def test_what_is_no_message(packet: bytes) -> None:
    with pytest.raises(MalformedMessage):
        decode(packet)


def test_numbers_keep_all_their_bits() -> None:
    values = [0.1, -0.0, 1e308, 5e-324, math.inf, -math.inf, 1 << 52, -(1 << 62), (1 << 63) - 1]
    again = decode(encode(1, 1, *values))[2:]
    assert [repr(v) for v in again] == [repr(v) for v in values]
    assert math.isnan(decode(encode(1, 1, math.nan))[2])


def test_a_refusal_is_bounded() -> None:
    assert len(decode(refusal(1, 22, "x" * 100_000))[3]) == MAX_TEXT


def test_a_long_reply_is_compressed_and_one_too_long_is_a_refusal() -> None:
    value = [["mod0.xaxis", 1.5, None, {"velocity": float(i)}] for i in range(5000)]
    packet = reply(7, value)
    assert len(encode(0, 7, 0, value)) > MAX_PACKET >= len(packet)
    message = decode(packet)
    assert message[:3] == [0, 7, 0] and message[4] is True and value_of(message) == value
    assert value_of(decode_reply(reply(7, [1]))) == [1]
    assert value_of(decode_reply(reply(7, [1], 99))) == [1] and decode(reply(7, [1], 99))[5] == 99
    assert decode(reply(7, value, 99))[5] == decode(refusal(7, 5, "no", 99))[5] == 99
    noise = random.Random(1).randbytes(2 * MAX_PACKET)
    refused = decode(reply(7, noise))
    assert refused[2] == errno.EMSGSIZE and str(MAX_PACKET) in refused[3]
    for odd in (b"", b"nonsense", None, packet):
        with pytest.raises(MalformedMessage):
            value_of([0, 7, 0, odd, True, 0])


NUMBERS = {
    ClientVerb: "HELLO=1 OPEN=2 CLOSE=3 LIST=4 INFO=5 STATUS=6 REPRESENT=7 JOURNAL=8 REPORT=9 RESERVE_MARKER=10 "
    "FREE_MARKER=11 SIGNAL_MARKER=12 WAIT_MARKER=13 EMERGENCY_STOP=20 RESET=21 RELOAD=22 CANCEL=30",
    HandleVerb: "WRITE=1 IOCTL=2 SUBSCRIBE=3 KEEPALIVE=4 CANCEL=5",
    DriverVerb: "ATTACH=1 DETACH=2 STOP_CHANGED=3 SHUTDOWN=4 INPUT=5 NODE_STOP=6 NODE_RESET=7 IN_USE=8 READY=20 "
    "DETACHED=21 MARKER_SIGNALLED=22 STOPPED=23 LINK=24 LOG=25",
    ForkServerVerb: "DESCRIBE=1 SPAWN=2",
    NodeClass: "BINARY=1 ANALOG=2 AXIS=3",
    Access: "READ=1 WRITE=2",
    Right: "READ=1 WRITE=2 STOP=4 ADMINISTER=8 ALL=15",
    PageState: "STARTING=0 GOOD=1 LINK_LOST=2 FAULT=3 STALE=4 CLOSED=5",
    WriteFlag: "APPEND=0 REPLACE=1 LATEST=2",
    AnalogStatus: "SATURATED=1 INVALID=2 OVERRUN=4",
    ControlMode: "JERK=1 ACCELERATION=2 VELOCITY=4 POSITION=8 FORCE=16 FORCE_VELOCITY=32 SPECIFIED_TIME=64 "
    "WAIT_FOR_EXTERNAL_SYNCH=128 SPECIFIED_GAINS=256 SPECIFIED_FORCE_OFFSET=512 SPECIFIED_MAX_VEL_ACC=1024 "
    "SPECIFIED_MAX_FORCE=2048 SPECIFIED_WAIT_MARKER=4096 SPECIFIED_SIGNAL_MARKER=8192 RELATIVE=16384",
    AxisStatus: "MOVING=1 FORCE_MODE=2 LIMIT_MINUS=4 LIMIT_PLUS=8 HOMED=16 FOLLOWING_ERROR=32 FAULT=64 "
    "EMERGENCY_STOP=128 WAITING_MARKER=256 WAITING_SYNCH=512 SATURATED=1024 HOMING=2048 STOPPING=4096 "
    "SWITCH_MINUS=8192 SWITCH_PLUS=16384 STALLED=32768",
    Request: "GET_IO_STRUCT_INFO=1 CALIBRATE_DEVICE=2 ZERO_DEVICE=3 WAIT_UNTIL_IDLE=4 SEND_EXTERNAL_SYNCH=5 "
    "EMERGENCY_STOP=6 SIGNAL_MARKER=7 WAIT_MARKER=8 RESERVE_MARKER=9 FREE_MARKER=10 WAIT_UNTIL_EVENT=11 SET_GAINS=12 "
    "GET_GAINS=13 STOP=20 RESET=21 HOME=22 SET_LIMITS=23 GET_LIMITS=24 FLUSH=25 CANCEL_WAITS=26 GET_STATISTICS=27",
}


@pytest.mark.parametrize("kind", NUMBERS, ids=lambda k: k.__name__)
def test_numbers_are_never_changed(kind: type) -> None:
    """Names may be added at the end; those that are there are facts of the wire."""
    fixed = {name: int(value) for name, value in (pair.split("=") for pair in NUMBERS[kind].split())}
    present = {name: int(getattr(kind, name)) for name in fixed}
    assert present == fixed


def test_golden_records() -> None:
    axis = AXIS_WRITE.pack(1, 0x2048, 7, 8, *[float(i) for i in range(15)])
    assert axis.hex() == (
        "01000000"
        "48200000"
        "0700000000000000"
        "0800000000000000"
        "0000000000000000"
        "000000000000f03f"
        "0000000000000040"
        "0000000000000840"
        "0000000000001040"
        "0000000000001440"
        "0000000000001840"
        "0000000000001c40"
        "0000000000002040"
        "0000000000002240"
        "0000000000002440"
        "0000000000002640"
        "0000000000002840"
        "0000000000002a40"
        "0000000000002c40"
    )
    assert BINARY_WRITE.pack(2, 0, 5, 7).hex() == "020000000000000005000000000000000700000000000000"
    assert ANALOG_WRITE.pack(3, 0, 0.5).hex() == "03000000" "00000000" "000000000000e03f"  # fmt: skip


def test_nothing_is_nested_deeper_than_messages_need() -> None:
    for depth in (MAX_DEPTH - 1, MAX_DEPTH, 1000, 30_000):
        packet = b"\x93\x01\x01" + b"\x91" * depth + b"\xc0"
        if depth < MAX_DEPTH:
            assert decode(packet)[2] != []
        else:
            with pytest.raises(MalformedMessage, match="nested more than 16 deep"):
                decode(packet)


def test_a_request_holds_a_bounded_number_of_values() -> None:
    argument = [[] for _ in range(MAX_VALUES)]
    packet = encode(HandleVerb.IOCTL, 1, 27, argument, 0.0)
    with pytest.raises(MalformedMessage, match="too many values"):
        take(packet, ON_HANDLE)
    assert decode(packet)[3] == argument, "a reply may hold more"


def test_what_unpacks_to_too_much_is_refused_before_it_is_unpacked() -> None:
    bomb = zlib.compress(b"\xc6" + (2 * MAX_UNPACKED).to_bytes(4, "big") + bytes(2 * MAX_UNPACKED))
    assert len(bomb) < MAX_PACKET
    with pytest.raises(MalformedMessage, match=str(MAX_UNPACKED)):
        value_of([0, 1, 0, bomb, True, 0])


@pytest.mark.parametrize(
    "message",
    [
        [0, 1], [0, 1, 0], [0, 1, None, 1], [0, 1, [], "x"], [0, 1, 5, None], [0, 1, 5, [1]], [0, 1, 0, None, 1],
        [0, 1, 0, None, False, None], [0, 1, 0, None, False, 1.5], [0, 1, 0, None, False, 0, 0], [0, 1, True, "x"],
        [1, 1, 0, None], [0, 0, 0, None], [0, 0, 0, "gone", False, 0],
    ],
)  # fmt: skip
def test_what_is_no_reply(message: list[object]) -> None:
    with pytest.raises(MalformedMessage):
        decode_reply(encode(*message))


def test_every_verb_takes_certain_kinds_and_nothing_else() -> None:
    for verbs in SOCKETS:
        for verb, kind_of in verbs.items():
            kinds = [*kind_of.fields.values()]
            good = [kind.types[0]() if kind.types else None for kind in kinds]
            assert take(encode(verb, 1, *good), verbs) == (1, kind_of.of(good))
            with pytest.raises(MalformedMessage, match="arguments"):
                take(encode(verb, 1, *good, None), verbs)
            for place, kind in enumerate(kinds):
                for odd in (None, True, 1, 1.5, math.nan, "x", "x" * 300, b"x", [1], {"a": 1}):
                    parts = [*good[:place], odd, *good[place + 1 :]]
                    fits = not kind.types or (type(odd) in kind.types and odd == odd)
                    if fits and not (kind.most and len(str(odd)) > kind.most):
                        take(encode(verb, 1, *parts), verbs)
                    else:
                        with pytest.raises(MalformedMessage, match="want"):
                            take(encode(verb, 1, *parts), verbs)
        with pytest.raises(MalformedMessage, match="does not exist"):
            take(encode(99, 1), verbs)


@pytest.mark.parametrize("text", ["a\x1b[2J", "a\r\nb", "\x00", "\u202e", "\ud800", "\x9b1m", "x" * 3000, "\n" * 3000])
def test_a_text_is_made_fit_for_a_terminal(text: str) -> None:
    shown = decode_reply(refusal(1, 5, text))[3]
    assert shown.isprintable() and 0 < len(shown) <= MAX_TEXT
    assert decode_reply(encode(0, 1, 5, text.encode("utf-8", "replace").decode()))[3].isprintable()


@given(
    st.lists(st.one_of(st.integers(-5, 70), st.booleans(), st.none(), st.floats(), st.text(max_size=5)), max_size=7),
    st.binary(max_size=3),
)
def test_a_short_reply_is_one_that_every_reader_takes_for_the_same(parts: list[object], behind: bytes) -> None:
    usual = [0, 7, 0, 1, False, 99]
    for message in (parts, [*usual[: len(parts) % 6], *parts][:6], usual):
        packet = encode(*message) + behind
        found = short_reply(packet, 7)
        if found is not None:
            assert found == decode_reply(packet) and found[1] == 7 and found[2] == 0
        else:
            assert behind or message != usual


def test_a_long_reply_is_no_short_one() -> None:
    assert short_reply(reply(7, "x" * 100, 99), 7) is None and short_reply(reply(7, 5, 99), 8) is None
    assert short_reply(reply(7, 5), 7) is None and short_reply(refusal(7, 5, "no", 99), 7) is None
    assert short_reply(reply(7, 5, 99), 7) == [0, 7, 0, 5, False, 99]
