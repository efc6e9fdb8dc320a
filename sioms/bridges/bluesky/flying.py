"""A fly scan: an axis moves, and a recording tells what it and the detectors did meanwhile, at full rate."""

from __future__ import annotations

import errno
import math
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from sioms.client.workcell import Workcell
from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.records import VALUE
from sioms.recording.live.files import LiveFile
from sioms.recording.live.recorder import Recorder
from sioms.recording.reader import Recording

from .devices import Axis, Device
from .status import Status, begin

BEGIN_S = 10.0
"""Longest time that the recorder may take to begin [s]."""


class FlyScan:
    """A motion of an axis from one place to another in a given time, recorded.

    Args:
        axis: what moves.
        detectors: what is recorded beside it.
        start, stop: from where to where [unit of the axis].
        duration: of the motion [s].
        folder: where recordings are written.
        name: of the scan.

    Attributes:
        path: of the last recording; '' before the first.
        lost: how many snapshots that lacks, by node; also a warning.

    In documents there is a stream for the axis and one for each detector, ``NAME_AXIS`` and so on, with an event for
    each snapshot. ``plan`` is a plan that stages, flies and collects. It cannot go on after a pause.

    Example:
        ``RE(FlyScan(axis, [force], 0.0, 0.1, 2.0, "runs").plan())``
    """

    parent = None

    def __init__(
        self, axis: Axis, detectors: Sequence[Device], start: float, stop: float, duration: float,
        folder: str | Path = ".", name: str = "fly",
    ) -> None:  # fmt: skip
        if not duration > 0:
            raise ValueError(f"fly {axis.name}: duration {duration!r}; want seconds above 0")
        for place in (start, stop):
            axis.check_value(place)
        self.axis, self.detectors = axis, list(detectors)
        self.start, self.stop_at, self.duration = float(start), float(stop), float(duration)
        self.name, self.path = name, ""
        self._folder = Path(folder)
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._failed: BaseException | None = None
        self._recorder: Recorder | None = None
        self._moves = self._cut = False
        self.lost: dict[str, int] = {}

    # --- the protocol of flyers --------------------------------------------------------------------

    def stage(self) -> list[Any]:
        """Take the axis."""
        return [self, *self.axis.stage()]

    def unstage(self) -> list[Any]:
        """End what is under way, and let go of axis and recorder."""
        self.cancel()
        return [self, *self.axis.unstage()]

    def kickoff(self) -> Status:
        """Go to the start, begin to record, and fly; it is done when the flight has begun."""
        return begin(f"begin {self.name}", self._begin)

    def complete(self) -> Status:
        """Wait for the end of the flight, and end the recording."""
        return begin(f"complete {self.name}", self._end)

    def describe_collect(self) -> dict[str, dict[str, Any]]:
        """Describe the streams."""
        return {f"{self.name}_{device.name}": device.describe() for device in self._devices}

    def collect(self) -> Iterator[dict[str, Any]]:
        """Yield what was recorded; a flight that is still under way is over with that."""
        self.cancel()
        if not self.path:
            return
        with Recording(self.path) as recording:
            for device in self._devices:
                if device.node_name in recording.nodes:
                    yield from _events(recording, device)

    def pause(self) -> None:
        """Stop: a flight cannot go on from where it was stopped.

        Raises:
            NoReplayAllowed: always, to tell the RunEngine so.
        """
        from bluesky.utils import NoReplayAllowed

        self.cancel()
        raise NoReplayAllowed

    def resume(self) -> None:
        """Do nothing: ``complete`` tells that the flight was stopped."""

    def plan(self, md: dict[str, Any] | None = None) -> Iterator[Any]:
        """Return a plan: stage, fly, collect, unstage."""
        from bluesky import plan_stubs, preprocessors

        about = {"plan_name": "sioms_fly", "axis": self.axis.name, "duration": self.duration, **(md or {})}

        def fly() -> Iterator[Any]:
            yield from plan_stubs.kickoff(self, wait=True)
            yield from plan_stubs.complete(self, wait=True)
            yield from plan_stubs.collect(self)

        stage: Any = preprocessors.stage_wrapper
        run: Any = preprocessors.run_wrapper
        plan: Iterator[Any] = stage(run(fly(), md=about), [self])
        return plan

    # --- what it does ------------------------------------------------------------------------------

    @property
    def _devices(self) -> list[Device]:
        return [self.axis, *self.detectors]

    def _begin(self) -> None:
        self.cancel()
        node = self.axis.take()
        node.move(self.start, replace=True)
        node.wait_until_idle()
        self._record()
        self._moves, self._cut = True, False
        node.move(self.stop_at, time=self.duration)

    def _record(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime()) + f"-{time.monotonic_ns() % 10**9:09d}Z"
        path = str(self._folder / f"{self.name}-{stamp}.mcap")
        nodes = [device.node_name for device in self._devices]
        address = self.axis.cell.address
        self._ending.clear()
        recorder = Recorder(LiveFile(path), lambda: Workcell(address, f"{self.name} recorder"), nodes)
        self.path, self._recorder, self._failed = path, recorder, None

        def run() -> None:
            try:
                recorder.run(self._ending.is_set)
            except BaseException as error:
                self._failed = error
            finally:
                recorder.close()

        self._thread = threading.Thread(target=run, name="recorder", daemon=True)
        self._thread.start()
        deadline = time.monotonic() + BEGIN_S
        while not all(recorder.recorded.get(node) for node in nodes):
            if self._failed is not None or time.monotonic() > deadline:
                self.cancel()
                raise self._failed or TimeoutError(f"record {', '.join(nodes)}: nothing came within {BEGIN_S:g} s")
            time.sleep(0.005)

    def _end(self) -> None:
        try:
            if self._moves:
                self.axis.take().wait_until_idle()
                self._moves = False
        finally:
            self.cancel()
        if self._cut:
            raise OSError(errno.ECANCELED, f"{self.name}: the flight was stopped on its way")
        if self._failed is not None:
            raise self._failed
        self.lost = {name: count for name, count in self._recorder.lost.items() if count} if self._recorder else {}
        if self.lost:
            warnings.warn(f"{self.name}: snapshots were lost on a busy machine: {self.lost}", stacklevel=1)

    def cancel(self) -> None:
        """Stop what moves, and end the recording in order."""
        if self._moves:
            self._moves, self._cut = False, True
            with suppress(OSError):
                self.axis.stop()
        self._ending.set()
        if self._thread is not None:
            self._thread.join()  # whoever else waits for it, too: after this the recording is whole


def _events(recording: Recording, device: Device) -> Iterator[dict[str, Any]]:
    """Yield an event for each snapshot of a device."""
    column = VALUE[device.info.node_class]
    columns = [column, "commanded_position"] if isinstance(device, Axis) else [column]
    is_analog = device.info.node_class is NodeClass.ANALOG
    table = recording.table(device.node_name, [*columns, "flags"] if is_analog else columns)
    if is_analog:
        table.values[column][(table.values["flags"] & AnalogStatus.INVALID) != 0] = math.nan
    keys = [*device.keys, f"{device.name}_setpoint"] if isinstance(device, Axis) else device.keys
    channels = range(len(device.info.channels))
    rows = zip(*[table.values[name][:, channel].tolist() for name in columns for channel in channels], strict=True)
    for stamp_ns, row in zip(table.stamps_ns.tolist(), rows, strict=True):
        stamp_s = (stamp_ns + recording.offset_ns) / 1e9
        yield {"time": stamp_s, "data": dict(zip(keys, row, strict=True)), "timestamps": dict.fromkeys(keys, stamp_s)}
