"""The black box: what it keeps, when it writes, and what it says began a trouble."""

from __future__ import annotations

import errno
import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from recording_rig import NODES, OFFSET_NS, slots

from sioms.recording import mcap
from sioms.recording.live import box as live
from sioms.recording.live.box import Box
from sioms.recording.messages import Event, NodeFormat
from sioms.recording.reader import Recording
from sioms.recording.story import sentence, tell


def filled(folder: Path, seconds: int, most_bytes: int = 10**9) -> Box:
    """Return a box after some seconds of a node at 1 kHz."""
    now_s = [0.0]
    box = Box(folder, most_bytes, 3.0, lambda: now_s[0])

    def schema(name: str, text: str) -> int:
        box.define(mcap.Schema(1 + ("Joint" in name), name, "ros2msg", text.encode()).packed())
        return 1 + ("Joint" in name)

    form = NodeFormat(NODES[0], -1, 1, schema, OFFSET_NS)
    for channel in form.channels:
        box.define(channel.packed())
    for first in range(1, 1000 * seconds, 100):
        now_s[0] += 0.1
        box.append(form.messages(slots(NODES[0], first, 100)))
        box.look()
    return box


def test_the_last_seconds_are_kept_and_no_more(tmp_path: Path) -> None:
    box = filled(tmp_path, 10)
    box.save(tmp_path / "a.mcap")
    with Recording(tmp_path / "a.mcap") as recording:
        kept = np.concatenate(list(recording.slots("mod0")))
    last = int(kept[-1, 0])
    assert 3000 <= len(kept) <= 4100 and last >= 9000
    assert np.array_equal(kept, slots(NODES[0], last - len(kept) + 1, len(kept)))
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_memory_is_bounded(tmp_path: Path) -> None:
    box = filled(tmp_path, 6)
    tight = filled(tmp_path, 6, box.size // 2)
    assert tight.dropped and 0 < tight.size <= box.size // 2


@pytest.mark.parametrize("why", ["stop", "request"])
def test_it_is_written_after_its_cause(tmp_path: Path, why: str) -> None:
    now_s = [0.0]
    box = Box(tmp_path, 10**9, 3.0, lambda: now_s[0])
    box.seen(Event(1, 1, "mod0", "command"))
    box.append(mcap.metadata("sioms", {}))
    if why == "stop":
        box.seen(Event(1, 1, "mod0", "stop", text="by eva", data={"stop": "EMERGENCY", "parts": []}))
    else:
        box.ask("request")
    box.look()
    assert bool(box._writers) is (why == "request")
    now_s[0] = 2.5
    box.look()
    box.close()
    assert [path.name.split("-")[1] for path in tmp_path.iterdir()] == [f"{why}.mcap"]


def test_what_came_last_is_in_the_box(tmp_path: Path) -> None:
    """And not only the seconds that are packed already."""
    box = filled(tmp_path, 2)
    box.append(mcap.metadata("last", {"word": "stop"}))
    box.ask("request")
    box.look()
    box.close()
    (path,) = tmp_path.iterdir()
    with Recording(path) as recording:
        for _ in recording.pieces():
            pass
        assert ("last", {"word": "stop"}) in recording.metadata


def killed(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def full(*_: object) -> None:
    raise OSError(errno.ENOSPC, "no space left on device")


@pytest.mark.parametrize("end", [killed, full])
def test_a_box_is_whole_before_it_is_packed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], end: Callable[..., None]
) -> None:
    monkeypatch.setattr(live, "rewrite", end)
    box = filled(tmp_path, 2)
    box.ask("request")
    box.look()
    box.close()
    (path,) = tmp_path.iterdir()
    with Recording(path) as recording:
        assert sum(map(len, recording.slots("mod0"))) == 2000 and not recording.is_packed
    assert not capfd.readouterr().err


def test_what_a_killed_keeper_left_becomes_a_box(tmp_path: Path) -> None:
    box = filled(tmp_path, 2)
    box.save(tmp_path / "a.mcap")
    whole = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "b.part").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "a.mcap.packing").write_bytes(whole[:100])
    live.clear_up(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "b.mcap"]
    with Recording(tmp_path / "b.mcap") as recording:
        assert 0 < sum(map(len, recording.slots("mod0"))) < 2000 and recording.damage


@pytest.mark.parametrize("fault", ["full", "a folder"])
def test_a_box_that_cannot_be_written_is_told_and_leaves_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], fault: str
) -> None:
    box = filled(tmp_path, 3)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    if fault == "a folder":
        box._folder = tmp_path / "gone"
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000 if fault == "full" else soft, hard))
    try:
        box.ask("request")
        box.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    told = capfd.readouterr().err
    assert "sioms blackbox: write " in told and "it is lost" in told
    assert list(tmp_path.iterdir()) == []


def at(ms: float, source: str, kind: str, text: str, **data: object) -> Event:
    return Event(int(ms * 1e6), 0, source, kind, text=text, data=data or None)


STOP = at(60_000, "mod0", "stop", "emergency stop by eva", stop="EMERGENCY", parts=[])
LOST = at(60_004, "daemon", "log", "device lost", device="mod1", reason="its driver process ended", level="error")
FAULT = at(60_000, "mod0", "fault", "following error", channels="xaxis")
OLD = at(1_000, "mod0", "stop", "emergency stop by tom", stop="EMERGENCY", parts=[])
HALT = at(59_999, "mod0", "stop", "its owner has gone", stop="CONTROLLED", parts=[])


@pytest.mark.parametrize(
    ("events", "cause", "text"),
    [
        ([], "request", "nothing"),
        ([HALT], "request", "nothing"),
        ([OLD, HALT, STOP], "stop", "eva"),
        ([OLD, STOP, LOST], "death", "driver of mod1 has died: its driver process ended"),
        ([OLD, FAULT, STOP], "fault", "fault of xaxis: following error"),
        ([STOP, at(60_003, "mod0", "fault", "later", channels="x")], "stop", "eva"),
        ([HALT, at(60_000, "recorder", "daemon gone", "the daemon has ended")], "death", "daemon has ended"),
    ],
)
def test_the_cause_is_named(events: list[Event], cause: str, text: str) -> None:
    story = tell(events)
    assert story.cause == cause and text in story.text
    assert OLD not in story.events or OLD is story.first


def test_sentences_name_who_and_why() -> None:
    command = Event(1, 1, "mod0", "command", "mod0", "eva", 34, "out of limits", {"verb": "Write", "records": 144})
    assert sentence(command) == "eva wrote 144 bytes of records to mod0, refused: out of limits"
    request = Event(1, 1, "daemon", "request", "", "tom", 0, "", {"verb": "Reset", "arguments": [""]})
    assert sentence(request) == "tom asked the daemon: Reset"
