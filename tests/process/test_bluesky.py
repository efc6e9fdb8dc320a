"""The RunEngine of bluesky moves, reads and flies; and whatever ends a plan stops and frees what it moved."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import Daemon, at_rest, raises, wait_for

import sioms

bluesky = pytest.importorskip("bluesky", reason="bluesky is not installed")
from bluesky import RunEngine, plan_stubs, plans, preprocessors  # noqa: E402
from bluesky.utils import RunEngineInterrupted  # noqa: E402

from sioms.bridges.bluesky import Axis, Detector, FlyScan, Output  # noqa: E402
from sioms.recording.reader import Recording  # noqa: E402


@pytest.fixture
def engine() -> Any:
    return RunEngine({}, context_managers=[])


@pytest.fixture
def axis(cell: sioms.Workcell) -> Axis:
    with cell.open("mod1.xaxis", "rw", timeout=5.0) as arm:
        arm.move(0.0)
        arm.wait_until_idle(5.0)
    return Axis(cell, "mod1.xaxis", "x")


def collected(engine: Any, plan: Any) -> dict[str, list[dict[str, Any]]]:
    """Run a plan; return the documents by kind."""
    documents: dict[str, list[dict[str, Any]]] = {}
    engine(plan, lambda kind, document: documents.setdefault(kind, []).append(document))
    return documents


def is_free(cell: sioms.Workcell, node: str = "mod1.xaxis") -> bool:
    with cell.open(node, "rw", timeout=5.0):
        return True


def later(seconds: float, what: Callable[[], object]) -> None:
    threading.Timer(seconds, what).start()


def test_a_scan_moves_reads_and_frees(engine: Any, axis: Axis, cell: sioms.Workcell) -> None:
    force, began_s = Detector(cell, "force0", "force"), time.time()
    documents = collected(engine, plans.scan([force], axis, 0.0, 0.02, 3))
    (descriptor,) = documents["descriptor"]
    assert descriptor["data_keys"]["x"]["units"] == "m" and descriptor["data_keys"]["force_fx"]["units"] == "N"
    assert descriptor["data_keys"]["x"]["source"] == "sioms:mod1.xaxis.xaxis.position"
    assert [e["data"]["x"] for e in documents["event"]] == pytest.approx([0.0, 0.01, 0.02], abs=1e-3)
    assert [e["data"]["x_setpoint"] for e in documents["event"]] == pytest.approx([0.0, 0.01, 0.02], abs=1e-9)
    times = [e["timestamps"]["force_fx"] for e in documents["event"]]
    assert times == sorted(set(times)) and began_s - 1 < times[0] < time.time() + 1, "each reading is a new one, by UTC"
    assert documents["stop"][0]["exit_status"] == "success" and is_free(cell)
    with pytest.raises(ValueError, match="5 m"):
        axis.check_value(5.0)
    with pytest.raises(OSError, match="position"):
        engine(plan_stubs.mv(axis, 5.0))
    assert is_free(cell), "what was refused holds nothing"


def test_a_staged_axis_is_held_and_an_output_is_until_it_is_released(
    engine: Any, axis: Axis, cell: sioms.Workcell
) -> None:
    bit = Output(cell, "io0.bit3", "bit")

    def plan() -> Any:
        yield from plan_stubs.mv(axis, 0.005, bit, 1)
        with raises(errno.EBUSY):
            cell.open("mod1", "rw")

    engine(preprocessors.stage_wrapper(plan(), [axis]))
    assert is_free(cell) and bit.is_held
    with cell.open("io0.bit3.readonly") as seen:
        assert seen.read().data[0] == 1
        bit.release()
        wait_for(lambda: seen.read().data[0] == 0, "the safe value")
    for node in ("mod0", "force0"):
        with raises(errno.EINVAL, node):
            Axis(cell, node)


def test_an_abort_stops_what_moved_and_frees_it(engine: Any, axis: Axis, cell: sioms.Workcell) -> None:
    with cell.open("mod1.xaxis.readonly") as seen:
        later(0.3, engine.request_pause)
        with pytest.raises(RunEngineInterrupted):
            engine(plans.rel_scan([], axis, 0.0, 0.9, 2))
        at_rest(seen)
        assert seen.read().position[0] < 0.85, "it was stopped on its way"
        assert axis.is_held, "a paused plan keeps what it has staged"
        engine.abort()
        assert is_free(cell) and not axis.is_held


def test_a_fly_scan_is_a_recording_and_its_events(
    engine: Any, axis: Axis, cell: sioms.Workcell, tmp_path: Path
) -> None:
    scan = FlyScan(axis, [Detector(cell, "force0", "force")], 0.0, 0.02, 0.4, tmp_path)
    documents = collected(engine, scan.plan())
    assert sorted(d["name"] for d in documents["descriptor"]) == ["fly_force", "fly_x"]
    events = [event for page in documents.get("event_page", []) for event in _rows(page)] or documents["event"]
    places = [event["data"]["x"] for event in events if "x" in event["data"]]
    assert len(places) > 100 and places[0] == pytest.approx(0, abs=1e-3) and places[-1] == pytest.approx(0.02, abs=1e-3)
    assert sum("force_fx" in event["data"] for event in events) > 20
    with Recording(scan.path) as recording:
        assert set(recording.nodes) == {"mod1.xaxis", "force0"} and recording.is_packed
        assert len(recording.table("mod1.xaxis").numbers) == len(places), "every snapshot is an event"
    assert is_free(cell)


def _rows(page: dict[str, Any]) -> list[dict[str, Any]]:
    count = len(page["time"])
    return [{"data": {key: values[i] for key, values in page["data"].items()}} for i in range(count)]


def test_an_aborted_flight_stops_and_frees_axis_and_recorder(
    engine: Any, axis: Axis, cell: sioms.Workcell, tmp_path: Path
) -> None:
    scan = FlyScan(axis, [], 0.1, 0.6, 5.0, tmp_path)
    with cell.open("mod1.xaxis.readonly") as seen:
        threads = threading.active_count()
        threading.Thread(
            target=lambda: (wait_for(lambda: seen.read().position[0] > 0.12, "flight"), engine.request_pause())
        ).start()
        with pytest.raises(RunEngineInterrupted):
            engine(scan.plan())
        at_rest(seen)
        assert seen.read().position[0] < 0.5
        with raises(errno.ECANCELED, "stopped on its way"):
            scan.complete().wait(5.0)
        engine.abort()
    assert is_free(cell)
    wait_for(lambda: threading.active_count() <= threads + 1, "the end of its threads")
    with Recording(scan.path) as recording:
        assert recording.is_packed and recording.damage == []


INTERRUPTED = """
import sys, sioms
from bluesky import RunEngine, plans
from bluesky.utils import RunEngineInterrupted
from sioms.bridges.bluesky import Axis
engine = RunEngine({})
axis = Axis(sioms.Workcell(sys.argv[1]), "mod1.xaxis")
print("ready", flush=True)
try:
    engine(plans.scan([], axis, 0.0, 0.9, 2))
except RunEngineInterrupted:
    print("interrupted", flush=True)
    engine.stop()
    print("stopped", axis.is_held, flush=True)
"""


def _hear_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # who runs tests in the background ignores them


@pytest.mark.usefixtures("axis")
def test_ctrl_c_stops(daemon: Daemon, cell: sioms.Workcell) -> None:
    command = [sys.executable, "-c", INTERRUPTED, daemon.socket]
    with (
        cell.open("mod1.xaxis.readonly") as seen,
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=_hear_interrupts) as process,
    ):
        wait_for(lambda: seen.read().position[0] > 0.05, "motion", 60.0)
        os.kill(process.pid, signal.SIGINT)
        time.sleep(0.2)
        os.kill(process.pid, signal.SIGINT)
        at_rest(seen)
        assert seen.read().position[0] < 0.85
        said = process.communicate(timeout=60)[0]
    assert "interrupted" in said and "stopped False" in said and is_free(cell)
