"""Traces: what is read from a file, and the peer that answers out of one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sioms.check.trace_command import configuration
from sioms.check.traces import BadTrace, Message, Replay, Trace, read_trace

HEADER = {
    "sioms_trace": 1,
    "device": "mod0",
    "driver": "tmcl",
    "table": {
        "module": 1140,
        "line": {"serial": "/dev/ttyUSB0", "baud": 9600},
        "axis": [{"name": "x", "homing": True}],
    },
}
MS = 1_000_000


def trace(*messages: tuple[int, str, bytes]) -> Trace:
    return Trace(HEADER, tuple(Message(t_ms * MS, 0, way, data) for t_ms, way, data in messages))


EXCHANGES = trace(
    (0, ">", b"id"),
    (2, "<", b"1140"),
    (10, ">", b"pos"),
    (12, "<", b"1"),
    (13, "<", b"0"),
    (20, ">", b"go"),
    (22, "<", b"ok"),
    (30, ">", b"pos"),
    (33, "<", b"20"),
)


def test_requests_draw_the_replies_of_their_time() -> None:
    replay = Replay(EXCHANGES)
    replay.take(b"id", 100 * MS)
    assert replay.due(101 * MS) == [] and replay.next_ns == 102 * MS
    assert replay.due(102 * MS) == [b"1140"]
    replay.take(b"po", 200 * MS)
    assert replay.mismatch is None, "the rest of it may come"
    replay.take(b"s", 201 * MS)
    assert replay.due(300 * MS) == [b"1", b"0"]


def test_what_nobody_asks_is_passed_and_what_is_asked_again_is_answered() -> None:
    replay = Replay(EXCHANGES)
    for _ in range(4):
        replay.take(b"pos", 0)
    assert replay.due(10 * MS) == [b"1", b"0", b"20", b"20", b"20"]
    assert (replay.matched, replay.again, replay.passed) == (2, 2, [b"id", b"go"])
    assert replay.finished and replay.mismatch is None


def test_the_first_mismatch_names_both_sides() -> None:
    replay = Replay(EXCHANGES)
    replay.take(b"id", 0)
    replay.take(b"pox", 0)
    replay.take(b"id", 0)
    assert replay.mismatch is not None and (replay.mismatch.expected, replay.mismatch.got) == (b"pos", b"pox")
    assert "message 2: the trace has 70 6f 73, the driver asks 70 6f 78; they differ from byte 2 on" in str(
        replay.mismatch
    )
    assert replay.report()["matched"] == 1, "nothing is answered after it"


def test_running_numbers_are_left_out_and_put_into_the_reply() -> None:
    numbered = trace((0, ">", b"\0\1read"), (1, "<", b"\0\1data"))
    replay = Replay(numbered, ignore=[(0, 2)])
    replay.take(b"\0\7read", 0)
    assert replay.due(MS) == [b"\0\7data"]


def test_a_device_that_pushes_goes_on() -> None:
    pushes = trace(
        (0, ">", b"start"),
        *((5 * i, "<", b"%d" % i) for i in range(1, 9)),
        (22, ">", b"hello"),
        (45, "<", b"end"),
    )
    replay = Replay(pushes)
    assert replay.stream
    replay.take(b"start", 0)
    assert replay.due(40 * MS) == [b"%d" % i for i in range(1, 9)]
    replay.take(b"hello", 40 * MS)
    assert replay.due(100 * MS) == [b"end"], "and nothing twice"


def test_a_file_is_read_up_to_where_it_was_cut(tmp_path: Path) -> None:
    path = tmp_path / "x.trace"
    lines = [
        json.dumps(HEADER),
        '{"t":1,"n":0,"e":"open","text":"/dev/ttyUSB0"}',
        '{"t":2,"n":0,"d":">","b":"0102"}',
        '{"t":3,"n":0',
    ]
    path.write_text("\n".join(lines))
    found = read_trace(path)
    assert found.messages == (Message(2, 0, ">", b"\1\2"),) and found.events == ((1, 0, "open", "/dev/ttyUSB0"),)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("hello\n", "is this a trace"),
        ('{"sioms_trace":7}\n', "version 7 of the format; want 1"),
        (json.dumps(HEADER) + '\n{"t":1}\n', "line 2"),
        (json.dumps(HEADER) + '\n{"t":1,"n":0,"d":">","b":"xy"}\n', "line 2"),
    ],
)
def test_what_is_no_trace_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "x.trace"
    path.write_text(text)
    with pytest.raises(BadTrace, match=words):
        read_trace(path)


def test_the_header_makes_the_configuration() -> None:
    import tomllib

    text, kind = configuration(EXCHANGES)
    device = tomllib.loads(text)["device"]["mod0"]
    assert kind == "serial" and device.pop("line") == {"serial": "{port}", "baud": 9600}
    assert device == {"driver": "tmcl", "module": 1140, "axis": [{"name": "x", "homing": True}]}
    with pytest.raises(BadTrace, match="line"):
        configuration(Trace({"sioms_trace": 1, "device": "x", "driver": "y", "table": {}}, ()))
