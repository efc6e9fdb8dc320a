"""A station: a driver at work under a daemon of its own, its simulator, the wire between them, and a client.

Concurrency: one thread; the processes are the station's own and end with it.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from sioms.children import ends_with_us
from sioms.client.workcell import Workcell, is_part
from sioms.descriptors import is_readable
from sioms.protocol.flags import READONLY, AxisStatus, ControlMode, NodeClass

from .daemon import Daemon
from .rigs import Axis, Output, Rig

ANSWER_S = 5.0
START_S = 90.0
"""Longest time until a process says that it is ready; on a busy machine it may get little of the processor [s]."""
UP_S = 15.0
STILL_S = 5.0
"""Longest time until an axis rests after a trial [s]."""
MOVED_S = 0.05
"""In which an axis that goes on at its rig's speed leaves its tolerance, twice over at least [s]."""
LOGGED_S = 1.0
"""Longest time until the daemon has written down what a driver has told it; the node shows it at once [s]."""
LOOKED_AT = 1000
"""Among so many of the last messages is what a reading was made of, however late somebody looks."""
LONGEST_PERIOD_S = 0.02
"""Longest time between two looks at what is waited for, unless its caller looks more rarely [s]."""
PRIORITY = 15
"""Of simulators and wires, where real-time priorities are allowed; the drivers' lies above."""


class Unanswered(RuntimeError):
    """A process of the station did not answer; the text says which and what."""


class Peer:
    """A process that says ``ready PORT`` and obeys lines: a simulator or a wire.

    Attributes:
        port: that it told.
        pid: of the process.
    """

    def __init__(self, command: Sequence[str], what: str, folder: Path | None = None) -> None:
        self.what = what
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=folder,
            env={**os.environ, "PYTHONUNBUFFERED": "1"}, bufsize=0,
            preexec_fn=ends_with_us(),
        )  # fmt: skip
        self.pid = self._process.pid
        self._rest = b""
        try:
            line = self._line(START_S)
            while not line.startswith("ready "):
                line = self._line(START_S)
        except Unanswered as error:
            self.close()
            said = self._process.stderr.read().decode("utf-8", "replace")[-600:] if self._process.stderr else ""
            raise Unanswered(f"start {what}: no line 'ready PORT' ({error}); it said: {said.strip()}") from None
        self.port = line.split(maxsplit=1)[1]
        with contextlib.suppress(OSError):  # a real device waits for nobody
            os.sched_setscheduler(self._process.pid, os.SCHED_FIFO, os.sched_param(PRIORITY))

    def tell(self, line: str) -> Any:
        """Send a command; return its answer's value.

        Raises:
            Unanswered: no answer, or an error.
        """
        if self._process.stdin is None:
            raise Unanswered(f"{self.what}: it takes no commands")
        try:
            self._process.stdin.write(line.encode() + b"\n")
        except OSError as error:
            raise Unanswered(f"{self.what}: {line}: it has ended ({error.strerror})") from None
        answer = self._line(ANSWER_S)
        if not answer.startswith("ok"):
            raise Unanswered(f"{self.what}: {line}: {answer}")
        return json.loads(answer[3:]) if answer[3:] else None

    def _line(self, timeout_s: float) -> str:
        deadline = time.monotonic() + timeout_s
        out = self._process.stdout
        while b"\n" not in self._rest:
            left = deadline - time.monotonic()
            if out is None or left <= 0 or not is_readable(out, left):
                raise Unanswered(f"{self.what}: no answer within {timeout_s:g} s")
            data = os.read(out.fileno(), 65536)
            if not data:
                raise Unanswered(f"{self.what}: it has ended")
            self._rest += data
        line, _, self._rest = self._rest.partition(b"\n")
        return line.decode("utf-8", "replace").strip()

    def close(self) -> None:
        """End the process."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        try:
            self._process.wait(2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@dataclass(frozen=True, slots=True)
class Node:
    """A node of the device under test."""

    name: str
    node_class: NodeClass
    read_only: bool

    @property
    def reader(self) -> str:
        """Name under which it is read without owning it."""
        return self.name if self.read_only else self.name + READONLY


class Station:
    """A driver at work. Use it in a ``with`` block.

    Args:
        rig: of the driver.
        paced: characters take the time of the configured line.
        wired: put a wire between; without, the driver speaks with its simulator directly.
        folder: where relative paths of the rig start: that of the driver's file.

    Attributes:
        rig: of the driver, its axes and outputs found out where it names none.
        simulator: of the device; None for a driver that needs none.
        wires: between them: of the line, and of what the device sends beside it; none for a driver without a line.
        nodes: of the device, one a block.
        noise: how far the readings of an analog node's channels lie apart at rest.
        cell: the session.
    """

    def __init__(self, rig: Rig, *, paced: bool = True, wired: bool = True, folder: Path | None = None) -> None:
        self.rig = rig
        self._base = folder or Path.cwd()
        self._folder = Path(tempfile.mkdtemp(prefix="sioms-check-"))
        self.simulator: Peer | None = None
        self.wires: list[Peer] = []
        self.noise: dict[str, list[float]] = {}
        self.daemon: Daemon | None = None
        self.cell: Workcell
        self.port = ""
        self._verbs: frozenset[str] | None = None
        self._log_of_before = 0  # characters of the daemon's log that were written before the last calm
        try:
            if rig.simulator:
                self._connect(paced, wired)
            self.start_daemon()
            self.wait_good()
            self._look()
        except BaseException:
            self.close()
            raise

    def _connect(self, paced: bool, wired: bool) -> None:
        rig = self.rig
        name, *options = rig.simulator
        program = ["-P", "-m", name]
        if name.endswith(".py"):
            program = [str((self._base / name).resolve())]
        link = [] if rig.tcp else ["--link", str(self._folder / "device")]
        command = [sys.executable, *program, *link, *options]
        self.simulator = Peer(command, f"simulator {name}", self._base)
        self.port = self.simulator.port
        if not (wired and rig.line):
            return
        speed = ["--baud", str(self.baud), "--bits", str(rig.bits_per_character)] if paced and self.baud else []
        for kind in (rig.line, "pushed") if rig.pushes else (rig.line,):
            command = [sys.executable, "-P", "-m", "sioms.check.wire", "--kind", kind, *speed]
            command += ["--device", self.simulator.port, "--link", str(self._folder / "port")]
            self.wires.append(Peer(command, "wire"))
        self.port = self.wires[0].port

    def processes(self) -> dict[str, int]:
        """Return the ids of the processes that a trial needs, by what they are."""
        found = {"the check": os.getpid()}
        if self.daemon is not None:
            found["the daemon"] = self.daemon.process.pid
            with contextlib.suppress(OSError):  # it has ended, or hangs
                found["the driver"] = self.status()["pid"]
        peers = {"the simulator": self.simulator, **{f"wire {i + 1}": wire for i, wire in enumerate(self.wires)}}
        found.update((what, peer.pid) for what, peer in peers.items() if peer is not None)
        return {what: pid for what, pid in found.items() if pid}

    @property
    def baud(self) -> float:
        """Speed of the serial line [baud], 0 where there is none."""
        return self.rig.setting("baud", 115200) if self.rig.line == "serial" else 0.0

    @property
    def character_s(self) -> float:
        """Time that a character takes on the line [s], 0 where it takes none."""
        return self.rig.bits_per_character / self.baud if self.baud else 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start_daemon(self) -> None:
        """Start a daemon with the device, and a session."""
        device = self.simulator.port if self.simulator is not None else ""
        text = self.rig.configured(self.port, device, self.wires[-1].port if len(self.wires) > 1 else "")
        driver = str(self._base / self.rig.driver)
        text = re.sub(r'(driver\s*=\s*")\{driver\}"', lambda found: f'{found[1]}{driver}"', text)
        # relative paths hold where the driver's file is, not in the daemon's folder
        text = re.sub(
            r'(driver\s*=\s*")(\.[^"]*\.py)"',
            lambda found: f'{found[1]}{(self._base / found[2]).resolve()}"',
            text,
        )
        self.daemon = Daemon('[workcell]\nname = "check"\n' + text)
        self._log_of_before = 0
        self.cell = self.daemon.cell("check")

    def end_daemon(self, *, kill: bool = False) -> None:
        """End or kill the daemon."""
        daemon, self.daemon = self.daemon, None
        if daemon is None:
            return
        if kill:
            daemon.process.kill()
        with contextlib.suppress(OSError):
            self.cell.close()
        daemon.close()

    def close(self) -> None:
        """End everything."""
        self.end_daemon()
        for peer in (*self.wires, self.simulator):
            if peer is not None:
                peer.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    # --- the device ------------------------------------------------------------------------------

    def _look(self) -> None:
        """Find out the nodes of the device, and its axes and outputs unless the rig tells them."""
        entries = [e for e in self.cell.nodes() if e.device == self.rig.device]
        whole = [e for e in entries if not is_part(e, entries) and not _is_same(e.name, {o.name for o in entries})]
        self.nodes = [Node(e.name, e.node_class, e.read_only) for e in whole]
        rig = self.rig
        if not rig.axes:
            names = [e.name for e in entries if e.node_class is NodeClass.AXIS and e.channels == 1]
            rig = replace(rig, axes=tuple(self._axis(name) for name in names if not name.endswith(READONLY)))
        if not rig.outputs:
            names = [e.name for e in whole if e.node_class is NodeClass.BINARY and not e.read_only]
            rig = replace(rig, outputs=tuple(Output(n, self.cell.info(n).channels[0].width, None) for n in names))
        self.rig = rig

    def _axis(self, name: str) -> Axis:
        channel = self.cell.info(name).channels[0]
        velocity = 0.2 * channel.limits["velocity"]
        low = -velocity if channel.minimum is None else channel.minimum
        high = velocity if channel.maximum is None else channel.maximum
        reach = min(velocity, 0.4 * (high - low))
        return Axis(name, reach, velocity, max(1e-3 * reach, 1e-6))

    def status(self) -> dict[str, Any]:
        """Return what the daemon says of the device."""
        found = [d for d in self.cell.status()["devices"] if d["name"] == self.rig.device]
        absent = {
            "state": "leaving",
            "link": "",
            "pid": 0,
            "generation": 0,
            "deaths": 0,
            "reason": "",
            "link_reason": "",
        }
        return dict(found[0]) if found else absent

    def is_good(self) -> bool:
        """Whether the driver is up and its link good."""
        status = self.status()
        return (status["state"], status["link"]) == ("up", "good")

    def wait_good(self, timeout_s: float = UP_S) -> float:
        """Wait until the driver is up and its link good; return how long that took [s].

        Raises:
            TimeoutError: it is not; the text holds what the daemon says.
        """
        began = time.monotonic()
        if not wait_for(self.is_good, timeout_s, 0.005):
            status = self.status()
            why = status["reason"] or status["link_reason"] or "no reason given"
            log = self.daemon.log() if self.daemon is not None else ""
            text = f"device {self.rig.device}: {status['state']}, link {status['link']}: {why}"
            said = _crash(log) or f"the daemon said: {log[-1500:]}"
            raise TimeoutError(f"{text}; not good within {timeout_s:g} s; {said}")
        return time.monotonic() - began

    def wait_fresh(self, timeout_s: float = UP_S) -> float:
        """Wait for a good link and a reading made from now on, so that nothing of before can lose it; return the time
        [s].

        Raises:
            TimeoutError: as wait_good.
        """
        began_ns = time.monotonic_ns()
        while True:
            self.wait_good(timeout_s - (time.monotonic_ns() - began_ns) / 1e9)
            with contextlib.suppress(OSError), self.cell.open(self.nodes[0].reader) as node:
                if wait_for(lambda: node.read().stamp_ns > began_ns, 0.5):
                    return (time.monotonic_ns() - began_ns) / 1e9

    def last_fault(self) -> str:
        """Return the last fault of an axis since all was calm, as the daemon logs it; '' when it logs none in time.

        An axis shows its fault in the tick that finds it, and its reason comes to the log behind that.
        """

        def told() -> str:
            log = self.daemon.log() if self.daemon is not None else ""
            found = re.findall(r'text="(fault of .*)"$', log[self._log_of_before :], re.MULTILINE)
            return str(found[-1]) if found else ""

        return str(wait_for(told, LOGGED_S))

    def has(self, mode: ControlMode) -> bool:
        """Whether the first axis has a control mode."""
        return bool(self.rig.axes and self.cell.info(self.rig.axes[0].node).channels[0].modes & mode)

    @property
    def verbs(self) -> frozenset[str]:
        """What the simulated device can be told; nothing for one that does not list it."""
        if self._verbs is None:
            self._verbs = frozenset()
            if self.simulator is not None:
                with contextlib.suppress(Unanswered):
                    self._verbs = frozenset(self.simulator.tell("verbs") or ())
        return self._verbs

    def speed(self) -> float | None:
        """Return how fast the device really moves, as its simulator says; None when that does not say."""
        if self.simulator is None:
            return None
        try:
            velocity = self.simulator.tell("state").get("velocity")
        except (Unanswered, AttributeError):
            return None
        return float(velocity) if isinstance(velocity, int | float) else None

    # --- the wire --------------------------------------------------------------------------------

    def tell_wire(self, line: str) -> list[Any]:
        """Send a command to all wires; return their answers."""
        if not self.wires:
            raise Unanswered("this driver has no wire")
        return [wire.tell(line) for wire in self.wires]

    def pull(self, verb: str) -> None:
        """Pull the cable ("unplug") or put it back ("plug"); of a device without a line its simulator does that."""
        if not self.wires and self.simulator is not None:
            self.simulator.tell(verb)
        else:
            self.tell_wire(verb)

    def fault(self, **keys: object) -> None:
        """Let the wire bend messages; none without keys."""
        self.tell_wire("fault " + json.dumps(keys, separators=(",", ":")))

    def totals(self) -> Mapping[str, int]:
        """Return what the wires have carried."""
        answers: list[dict[str, int]] = self.tell_wire("totals")
        return {key: sum(each[key] for each in answers) for key in answers[0]}

    def messages(self, count: int) -> list[list[Any]]:
        """Return the last messages: time [ns], direction, hex, what was done to it."""
        first, *others = self.tell_wire(f"log {count}")
        return sorted(itertools.chain(first, *others))[-count:] if others else first

    def exchanges(self, count: int = 8, until_ns: int = 0) -> list[str]:
        """Return messages as lines to print.

        Args:
            count: how many.
            until_ns: what was read by then was made of the last of them [ns]; who looks late finds others behind. With
                them comes the last one that was bent, however long ago. 0: the last of all.
        """
        if not self.wires:
            return []
        now_ns = time.monotonic_ns()
        if until_ns:
            known = [entry for entry in sorted(self.messages(LOOKED_AT)) if entry[0] <= until_ns]
            entries = known[-count:]
            if not any(note for *_, note in entries):
                entries = [entry for entry in known if entry[3]][-1:] + entries
        else:
            entries = self.messages(count)
        return [
            f"{(t_ns - now_ns) / 1e6:9.2f} ms {way} {' '.join(text[i : i + 2] for i in range(0, len(text), 2))}"
            + (f"   ({note})" if note else "")
            for t_ns, way, text, note in entries
        ]

    def settle(self) -> None:
        """Bring all back to calm: no faults, no stop, link good, axes at rest.

        Raises:
            RuntimeError: an axis goes on; its device is of no use for another trial.
            OSError: as wait_good.
        """
        if self.wires:
            self.fault()
            self.tell_wire("plug")
        if self.daemon is None or self.daemon.process.poll() is not None:
            self.end_daemon()
            self.start_daemon()
        if self.simulator is not None and "reference" in self.verbs:
            self.simulator.tell("reference off")
        self.wait_fresh()
        self.cell.reset()
        for axis in self.rig.axes[:1]:
            with contextlib.suppress(OSError), self.cell.open(axis.node, "rw", timeout=2.0) as node:
                node.reset()
                _wait_sound(node)
            with self.cell.open(f"{axis.node}{READONLY}") as seen:
                _wait_still(seen, axis)
        self._log_of_before = len(self.daemon.log()) if self.daemon is not None else 0

    def start_client(self, script: str, *words: str) -> Client:
        """Start a client in a process of its own; it must print a line when it is ready."""
        if self.daemon is None:
            raise Unanswered("no daemon runs")
        return Client(script, self.daemon.socket, *words)


def _crash(log: str) -> str:
    """Return the last exception of a driver in a daemon's log, with where it was raised; '' when there is none."""
    found = re.findall(r'text="(driver failed: .*)"$', log, re.MULTILINE)
    words = found[-1].replace('\\"', '"').split() if found else []
    return " ".join(word for word in words if word.strip("~^"))  # without the marks below a line of code


def _wait_sound(node: Any) -> None:
    """Wait until a reset has taken effect."""
    wait_for(lambda: not node.read().status[0] & AxisStatus.FAULT, 2.0)


def _wait_still(seen: Any, axis: Axis) -> None:
    """Wait until an axis rests in the place where its device says it is."""

    def rests() -> bool:
        try:
            first = last = seen.read()
            while last.stamp_ns < first.stamp_ns + MOVED_S * 1e9:  # a device may be polled as seldom
                time.sleep(MOVED_S / 10)
                last = seen.read()
        except OSError:  # its link is lost once more, as that of a device that the machine holds up, and comes back
            return False
        return not last.in_motion[0] and abs(last.position[0] - first.position[0]) <= axis.tolerance

    if not wait_for(rests, STILL_S):
        reading = seen.read()
        told = f"in_motion {reading.in_motion[0]}, position {reading.position[0]:.6g}"
        raise RuntimeError(f"{axis.node} does not come to rest within {STILL_S:g} s after the trial: {told}")


def _is_same(name: str, names: set[str]) -> bool:
    """Tell whether a node of one channel has a shorter name, too: that of its device."""
    return name.rpartition(".")[0] in names


PROLOGUE = "import sys, time, sioms\ncell = sioms.Workcell(sys.argv[1], 'victim')\n"


class Client:
    """A client process that can be killed."""

    def __init__(self, script: str, *words: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", PROLOGUE + script, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, preexec_fn=ends_with_us(),
        )  # fmt: skip
        line = self._process.stdout.readline() if self._process.stdout else ""
        if not line:
            said = self._process.stderr.read()[-400:] if self._process.stderr else ""
            self.kill()
            raise OSError(5, f"the client of the trial failed: {said.strip()}")

    def kill(self) -> None:
        """SIGKILL."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for stream in (self._process.stdout, self._process.stderr):
            if stream is not None:
                stream.close()


def wait_for(condition: Callable[[], Any], timeout_s: float, period_s: float = 0.003) -> Any:
    """Look until something is true; return it, or what it was last when the time is over.

    What takes long is looked for less often, to a twentieth of its time: who is asked has better things to do.
    """
    began = time.monotonic()
    while not (found := condition()) and (passed_s := time.monotonic() - began) < timeout_s:
        time.sleep(period_s and max(period_s, min(0.05 * passed_s, LONGEST_PERIOD_S)))
    return found
