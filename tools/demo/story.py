"""The story that the demo tells."""

from __future__ import annotations

import errno
import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from importlib.resources import files

import sioms
from sioms.children import PATIENCE_S, Process, daemon
from sioms.client.command import command

from . import measure
from .pace import RATES, paced, rate_for, share
from .recorder import Recorder
from .rig import bold, tool, waiting

STILL = 1e-3
"""Measured velocity below which an axis whose motion has ended is told to be at rest [m/s]."""


def tell(out: str, quick: bool, wire: bool) -> int:
    """Run the demo; return the exit status."""
    os.makedirs(out, exist_ok=True)
    config = str(files("sioms.tools.demo").joinpath("demo.toml"))
    with tempfile.TemporaryDirectory(prefix="sioms-demo-") as folder:
        _chapter("Start the daemon", f"siomsd --config {os.path.relpath(config)}")
        config = _paced(config, folder)
        began = time.monotonic()
        with waiting("siomsd to start its drivers"):
            process = daemon(config, f"{folder}/demo.sock")
        try:
            with sioms.Workcell(name="demo") as cell:
                _say(f"ready after {time.monotonic() - began:.2f} s")
                _list_nodes(cell)
                _Show(cell, out).run(quick)
        finally:
            process.end()
        if wire:
            from .wire import show

            show(folder)
    print(f"\nPicture: {out}/demo.png")
    return 0


def _paced(config: str, folder: str) -> str:
    """Return the configuration to use: on a busy machine a copy with slower ticks."""
    rate_hz = rate_for(share())
    if rate_hz == RATES[0][1]:
        return config
    _say(f"this machine is busy: the simulated devices tick at {rate_hz:.0f} Hz instead of {RATES[0][1]:.0f}")
    shutil.copytree(os.path.dirname(config), f"{folder}/config", ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    slower = f"{folder}/config/demo.toml"
    with open(config, encoding="utf-8") as file:
        text = paced(file.read(), rate_hz)
    with open(slower, "w", encoding="utf-8") as file:
        file.write(text)
    return slower


def _chapter(title: str, text: str = "") -> None:
    print(f"\n{bold(title)}" + (f"   {text}" if text else ""), flush=True)


def _say(text: str) -> None:
    print(f"  {text}", flush=True)


def _list_nodes(cell: sioms.Workcell) -> None:
    _chapter("What there is", "sioms list")
    shown = [node for node in cell.nodes() if node.name.count(".") == 0]
    for node in shown:
        kind = node.node_class.name.lower()
        _say(
            f"{node.name:10} {kind:7} {node.channels:3} channel{'s' if node.channels > 1 else ' '}  {node.device}: "
            f"{node.state}"
        )
    _say(f"... and {len(cell.nodes()) - len(shown)} more: single axes and bits, groups, read-only companions")


class _Show:
    """The chapters on the simulated workcell, recorded from the side."""

    def __init__(self, cell: sioms.Workcell, out: str) -> None:
        self._cell = cell
        self._out = out
        self._recorder = recorder = Recorder(cell)
        positions = recorder.add(
            "mod0.readonly",
            **{"mod0 x": lambda s: s.position[0] * 1e3, "mod0 y": lambda s: s.position[1] * 1e3},
        )
        velocities = recorder.add(
            "mod0.xy.readonly", **{"mod0 x": lambda s: s.velocity[0], "mod0 y": lambda s: s.velocity[1]}
        )
        others = recorder.add(
            "mod1.readonly",
            **{"mod1 x": lambda s: s.position[0] * 1e3, "mod1 z": lambda s: s.position[2] * 1e3},
        )
        others_v = recorder.add("mod1.xaxis.readonly", **{"mod1 x": lambda s: s.velocity[0]})
        force = recorder.add("lord1", **{"lord1 fz": lambda s: s.data[2]})
        motor = recorder.add("mod1.zaxis.readonly", **{"mod1 z motor": lambda s: s.force[0]})
        beams = recorder.add("beams", **{f"beam{i}": lambda s, i=i: (s.data[0] >> i & 1) + 1.5 * i for i in range(3)})
        self._rows = [
            ("position [mm]", positions + others),
            ("velocity [m/s]", velocities + others_v),
            ("force [N]", force + motor),
            ("beams (up = broken)", beams),
        ]
        self._chapters: list[tuple[float, str]] = []

    def run(self, quick: bool) -> None:
        """Play all chapters, draw the picture, measure."""
        self._recorder.start()
        try:
            self._trajectory()
            self._beam()
            self._finger()
            self._pipes()
            self._kill()
            self._stop()
        finally:
            self._recorder.stop()
        _chapter("The picture", "position, velocity, force and events over time")
        try:
            from .picture import draw
        except ImportError:
            _say("left out: matplotlib is not installed (pip install 'sioms[report]')")
        else:
            with waiting("the picture"):
                draw(f"{self._out}/demo.png", self._rows, self._recorder.events, self._chapters)
            _say(f"{self._out}/demo.png")
        self._latencies(quick)

    def _begin(self, title: str, text: str, short: str) -> None:
        _chapter(title, text)
        self._chapters.append(((time.monotonic_ns() - self._recorder.start_ns) / 1e9, short))

    def _note(self, text: str, stamp_ns: int | None = None) -> None:
        self._recorder.event(text, stamp_ns)
        _say(text)

    def _trajectory(self) -> None:
        self._begin(
            "Two modules in step",
            "buffers filled beforehand, one synchronised start, markers between the modules",
            "markers and synch",
        )
        cell = self._cell
        with cell.open("mod0", "rw", PATIENCE_S) as mod0, cell.open("mod1", "rw", PATIENCE_S) as mod1:
            picked, placed = cell.reserve_markers(2)
            start_ns = self._start_together(mod0, mod1, int(picked), int(placed))
            self._note("synch: both modules start", start_ns)
            with waiting("marker 1, which mod0 signals"):
                self._note("marker 1: mod0 has picked", picked.wait(PATIENCE_S))
            with waiting("marker 2, which mod1 signals"):
                self._note("marker 2: mod1 has made room", placed.wait(PATIENCE_S))
            self._rest(mod0, mod1)
            self._note("both modules at rest")

    def _start_together(self, mod0: sioms.AxisNode, mod1: sioms.AxisNode, picked: int, placed: int) -> int:
        """Fill the buffers and start both; once more, and later, when the machine was too busy; return when."""
        lead_s = 2.0
        while True:
            mod0.write([
                command(0, position=0.18, synch=True),
                command(1, position=0.12, synch=True),
                command(0, position=0.05, time=0.6, signal=picked),
                command(0, position=0.30, wait=placed),
                command(1, position=0.0, wait=placed),
            ])  # fmt: skip
            mod1.write([
                command(0, position=0.10, synch=True),
                command(0, position=0.25, wait=picked, signal=placed),
                command(0, position=0.05),
            ])  # fmt: skip
            _say(
                f"buffered: mod0 {list(mod0.read().buffered)}, mod1 {list(mod1.read().buffered)} commands; nothing "
                "moves yet"
            )
            try:
                return self._cell.synch(mod0, mod1, lead=lead_s)
            except OSError as error:
                if error.errno != errno.ETIME or lead_s > PATIENCE_S:
                    raise
            _say(f"the machine is too busy for a start {lead_s:g} s ahead")
            lead_s *= 4.0
            for node in (mod0, mod1):
                node.stop()
            self._rest(mod0, mod1)

    @staticmethod
    def _rest(*nodes: sioms.AxisNode) -> None:
        for node in nodes:
            with waiting(f"{node.name} to come to rest"):
                node.wait_until_idle(PATIENCE_S)

    def _beam(self) -> None:
        self._begin(
            "React to a light beam",
            "a moving axis breaks a beam; the program waits for the edge",
            "light beam",
        )
        with self._cell.open("mod0.xaxis", "rw", PATIENCE_S) as axis, self._cell.open("beam0") as beam:
            before = beam.read()
            axis.move(0.0, max_velocity=0.25, max_acceleration=3.0)
            with waiting("beam 0 to be broken by mod0.xaxis"):
                broken = beam.wait_event(last=before, timeout=PATIENCE_S)
            awake_us = (time.monotonic_ns() - broken.stamp_ns) / 1e3
            self._note("beam 0 broken", broken.stamp_ns)
            with waiting("beam 0 to be free again"):
                free = beam.wait_event(last=broken, timeout=PATIENCE_S)
            axis.move(0.12, replace=True, max_velocity=0.6, max_acceleration=6.0)
            self._note("beam 0 free again: turn back", free.stamp_ns)
            width_mm = (free.stamp_ns - broken.stamp_ns) / 1e9 * 0.25 * 1e3
            _say(
                f"awake {awake_us:.0f} us after the edge; the edges' stamps make the beam {width_mm:.2f} mm wide (it "
                "is 40 mm)"
            )
            self._rest(axis)

    def _finger(self) -> None:
        self._begin(
            "Press on the tactile finger",
            "a force-guarded move; the array sees where and how hard",
            "tactile finger",
        )
        with (
            self._cell.open("mod1.zaxis", "rw", PATIENCE_S) as axis,
            self._cell.open("lord1") as sensor,
            self._cell.open("tactile0") as finger,
            self._cell.open("tactile0.shape") as shape,
        ):
            sensor.zero(50)
            finger.zero(20)
            # However late this program may be to stop it, it presses no deeper than 1.5 mm, with 6 N.
            axis.move(0.0215, max_velocity=0.02, max_acceleration=4.0)
            with waiting("a force above 0.5 N at lord1"):
                while abs(sensor.read().measured(2)) < 0.5:
                    sensor.wait_new(sensor.read().number, PATIENCE_S)
            self._note("touch: force above 0.5 N")
            axis.command(force=6.0, time=0.8, replace=True)
            time.sleep(0.7)
            snapshot = finger.read()
            self._note(f"pressed with {abs(sensor.read().data[2]):.2f} N")
            peak = max(abs(v) for v in snapshot.data) or 1.0
            for index, value in enumerate(snapshot.data):
                _say(f"element {index:2} {value:+7.2f} %  {'#' * round(40 * abs(value) / peak)}")
            felt = dict(zip((channel.name for channel in shape.info.channels), shape.read().data, strict=True))
            _say(
                f"shape: {math.degrees(felt['angle']):.2f} +- {math.degrees(felt['var_angle'] ** 0.5):.2f} deg, "
                f"{felt['load']:.0f} N/m, radius {1e3 * felt['radius']:.1f} mm (it is 6 mm)"
            )
            self._rest(axis)
            axis.move(0.0)
            self._rest(axis)
            self._note("finger free again")

    def _pipes(self) -> None:
        self._begin("From the shell", "the same nodes through pipes", "pipes")
        for name, *arguments in (
            ["devin", "mod0"],
            ["devout", "-pt", "mod0.xaxis", "0.05", "0.4"],
            ["devin", "-n0p", "mod0"],
        ):
            with waiting(f"{name} to end"):
                text = tool(name, *arguments)
            _say(f"$ {name} {' '.join(arguments)}")
            for line in text.splitlines():
                _say(line)

    def _kill(self) -> None:
        self._begin("Kill a client in mid-motion", "SIGKILL; nobody is left to say stop", "client killed")
        with self._cell.open("mod0.xaxis.readonly") as watch:
            with waiting("a client that moves mod0.xaxis"):
                victim = Process(["sioms.tools.demo.victim", "mod0.xaxis", "0.2"], "moving")
            time.sleep(0.6)
            try:
                self._cell.open("mod0.xaxis", "rw").close()
            except OSError as error:
                _say(f"before: {error.strerror}")
            self._note("SIGKILL to the client", victim.kill())
            with waiting("the axis of the killed client to come to rest"):
                measure.wait_for_rest(watch, slower_than=STILL)
            reading = watch.read()[0]
            self._note(f"axis at rest: {abs(reading.velocity):.4f} m/s")
            with waiting("mod0.xaxis to be free"):
                self._cell.open("mod0.xaxis", "rw", PATIENCE_S).close()
            _say("and free for the next client")

    def _stop(self) -> None:
        self._begin("Emergency stop", "any client may; latched until somebody entitled resets it", "emergency stop")
        cell = self._cell
        with cell.open("mod0", "rw", PATIENCE_S) as mod0, cell.open("mod1", "rw", PATIENCE_S) as mod1:
            for node in (mod0, mod1):
                node.write([command(axis, velocity=0.15) for axis in range(2)])
            time.sleep(0.5)
            self._note("emergency stop")
            cell.emergency_stop(why="demo")
            try:
                mod0.move(0.0)
            except OSError as error:
                _say(f"a write now: {error.strerror}")
            time.sleep(0.3)
            cell.reset()
            self._note("reset: nothing resumes by itself")
            time.sleep(0.3)
            for node in (mod0, mod1):
                node.write([command(axis, position=0.0) for axis in range(2)])
            self._note("new commands: back to zero")
            self._rest(mod0, mod1)

    def _latencies(self, quick: bool) -> None:
        _chapter("How fast", "medians and worst cases of this run on this machine")
        few, many = (5, 500) if quick else (25, 5000)
        cell = self._cell
        rows: list[measure.Row] = []
        measurements: list[Callable[[], measure.Row]] = [
            lambda: measure.socket_round_trip(many),
            lambda: measure.reading(cell, many),
            lambda: measure.writing(cell, many // 5),
            lambda: measure.edge_to_client(cell, few),
            lambda: measure.kill_to_halt(cell, few),
            lambda: measure.stop_to_halt(cell, few),
        ]
        for measured in measurements:
            with waiting(f"measurement {len(rows) + 1} of {len(measurements)}"):
                rows.append(measured())
        base = rows[0].median_us
        _say(f"{'':38} {'median':>11} {'worst':>12} {'trials':>7} {'round trips':>12}")
        for row in rows:
            _say(
                f"{row.what:38} {row.median_us:8.1f} us {row.worst_us:9.1f} us {row.trials:7} "
                f"{row.median_us / base:12.2f}"
            )
