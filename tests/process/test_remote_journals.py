"""What a recording of a cell on another machine tells of who did what, and to whom it does not."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path

from daemon_rig import WORKCELL, Daemon, raises, wait_for

import sioms
from sioms.check.remote import Gateway
from sioms.recording.live.files import LiveFile
from sioms.recording.live.recorder import Recorder
from sioms.recording.reader import Recording

GRANTS = """
[[grant]]
keys = ["eva"]
nodes = ["*"]
rights = ["read", "write", "stop", "administer"]
"""
PLAIN = GRANTS.replace(', "administer"', "")


def test_a_remote_recording_holds_commands_stops_and_log_until_the_right_ends(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    daemon, path, said = start_daemon(WORKCELL + GRANTS), tmp_path / "far.mcap", list[str]()
    with Gateway(daemon.socket) as gate, daemon.cell("tom") as cell:
        recorder = Recorder(LiveFile(str(path)), lambda: sioms.Workcell(gate.socket), ["mod0"], log=said.append)
        assert not said, "everything is recorded"
        with cell.open("mod0.xaxis", "rw") as axis:
            axis.move(0.01)
            with raises(errno.ERANGE):
                axis.move(50.0)
        marker = cell.reserve_marker()
        marker.signal()
        cell.emergency_stop_workcell("a test")
        cell.report("warning", "seen from afar")
        recorder.look()
        wait_for(lambda: recorder.look() is not None and "seen from afar" in _texts(path), "the events")
        daemon.configure(WORKCELL + PLAIN)
        cell.reload()
        wait_for(lambda: recorder.look() is not None and said, "the end of the right")
        assert "right to administer" in said[0]
        cell.report("warning", "seen by nobody")
        assert recorder.cell is not None and recorder.cell.nodes(), "the session goes on"
        with raises(errno.EPERM, "administer"):
            recorder.cell.journal()
        recorder.look()
        recorder.close()
    with Recording(path) as recording:
        events = recording.events()
    commands = [e for e in events if e.kind == "command" and e.node == "mod0.xaxis"]
    assert {(e.error, "tom" in e.who) for e in commands} >= {(0, True), (errno.ERANGE, True)}
    assert any("position" in e.text and e.error == errno.ERANGE for e in commands)
    told = {(e.source, e.kind) for e in events}
    assert {("mod0", "stop"), ("mod1", "stop"), ("daemon", "log"), ("daemon", "request"), ("daemon", "closed")} <= told
    assert any(e.kind == "request" and (e.data or {}).get("verb") == "SignalMarker" for e in events)
    assert "seen by nobody" not in str(events) and not [e for e in events if "events" in (e.data or {})]


def _texts(path: Path) -> str:
    with Recording(path) as recording:
        return str([event.data for event in recording.events()])


def test_a_key_without_the_right_records_readings_only_and_is_told(daemon: Daemon, tmp_path: Path) -> None:
    said = list[str]()
    with Gateway(daemon.socket) as gate:
        file = LiveFile(str(tmp_path / "a.mcap"))
        recorder = Recorder(file, lambda: sioms.Workcell(gate.socket), ["mod0"], log=said.append)
        wait_for(lambda: recorder.look(), "snapshots")
        recorder.close()
    assert "only readings are recorded" in said[0] and "eva" in said[0]
