"""Axes, sensors and outputs as devices: moved, read, staged and stopped by a RunEngine.

An axis or output is held, and nobody else moves it, from ``stage`` to ``unstage``; an axis that is moved without being
staged, from the beginning of the motion to its end. Its lease is renewed by a thread while it is held: a process that
is killed or stopped halts it, and a point move ends by itself.
"""

from __future__ import annotations

import errno
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from sioms.client.workcell import Workcell
from sioms.protocol.flags import READONLY, NodeClass
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.records import VALUE

from .status import Status, begin

LEASE_S = 2.0
"""Of what is held [s]: a process that is silent for so long has it halted."""
TRIGGER_S = 5.0
"""Longest wait for a reading [s]."""


class Device:
    """A node.

    Args:
        cell: the session.
        node: its name.
        name: in documents; '': that of the node, with ``_`` for dots.
        classes: what the node must be.

    Raises:
        OSError: no such node, or of another class.
    """

    parent = None

    def __init__(self, cell: Workcell, node: str, name: str, classes: Sequence[NodeClass]) -> None:
        self.cell, self.node_name = cell, node
        self.name = name or node.replace(".", "_")
        self.info: NodeInfo = cell.info(node)
        if self.info.node_class not in classes:
            wanted = " or ".join(each.name.lower() for each in classes)
            text = (
                f"{type(self).__name__} of {node}: a node of class {self.info.node_class.name.lower()}; want {wanted}"
            )
            raise OSError(errno.EINVAL, text)
        self._seen: Any = None

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name}: {self.node_name}>"

    @property
    def readings(self) -> Any:
        """The node for reading, which takes nothing from anybody."""
        if self._seen is None or self._seen.closed:
            self._seen = self.cell.open(self.node_name if self.info.read_only else self.node_name + READONLY)
        return self._seen

    @property
    def keys(self) -> list[str]:
        """Keys of the values in documents, one a channel."""
        channels = self.info.channels
        return [self.name] if len(channels) == 1 else [f"{self.name}_{channel.name}" for channel in channels]

    @property
    def hints(self) -> dict[str, list[str]]:
        """What is of interest to plots and tables."""
        return {"fields": self.keys}

    def describe(self) -> dict[str, Any]:
        """Describe the values: source, type, unit and range."""
        column = VALUE[self.info.node_class]
        return {key: self.described(i, column) for i, key in enumerate(self.keys)}

    def described(self, channel: int, column: str) -> dict[str, Any]:
        """Describe a column of a channel."""
        about = self.info.channels[channel]
        source = f"sioms:{self.node_name}.{about.name}.{column}"
        if self.info.node_class is NodeClass.BINARY:
            return {"source": source, "dtype": "integer", "shape": []}
        told = {"source": source, "dtype": "number", "shape": [], "units": about.unit, "precision": 6}
        if about.minimum is not None and about.maximum is not None:
            told["limits"] = {"control": {"low": about.minimum, "high": about.maximum}}
        return told

    def read(self) -> dict[str, Any]:
        """Return the newest values with their times by UTC [s]."""
        return self.told(self.readings.read())

    def told(self, snapshot: Any) -> dict[str, Any]:
        """Return the values of a snapshot; an analog one that is INVALID is nan."""
        is_analog = self.info.node_class is NodeClass.ANALOG
        values = snapshot.known if is_analog else getattr(snapshot, VALUE[self.info.node_class])
        stamp_s = snapshot.utc.ns / 1e9
        return {key: {"value": value, "timestamp": stamp_s} for key, value in zip(self.keys, values, strict=True)}

    def describe_configuration(self) -> dict[str, Any]:
        """Describe what does not change in a run."""
        return {f"{self.name}_node": {"source": f"sioms:{self.node_name}", "dtype": "string", "shape": []}}

    def read_configuration(self) -> dict[str, Any]:
        """Return what does not change in a run: the name of the node."""
        stamp_s = self.readings.read().utc.ns / 1e9
        return {f"{self.name}_node": {"value": self.node_name, "timestamp": stamp_s}}


class Detector(Device):
    """An analog node, or any other that is only read.

    Args:
        cell: the session.
        node: its name.
        name: in documents; '': that of the node.

    Example:
        ``RE(count([Detector(cell, "lord1")], 5))``
    """

    def __init__(self, cell: Workcell, node: str, name: str = "") -> None:
        super().__init__(cell, node, name, list(NodeClass))
        self._taken: Any = None

    def trigger(self) -> Status:
        """Take a reading that was measured from now on."""
        node = self.readings
        before = node.read()

        def take() -> None:
            self._taken = node.wait_new(before.number, TRIGGER_S)

        return begin(f"take a reading of {self.node_name}", take)

    def read(self) -> dict[str, Any]:
        """Return the values that were taken last, else the newest."""
        return super().read() if self._taken is None else self.told(self._taken)

    def stage(self) -> list[Any]:
        """Begin a run."""
        self._taken = None
        return [self]

    def unstage(self) -> list[Any]:
        """End a run."""
        self._taken = None
        return [self]


class Held(Device):
    """A node that is held while it is staged."""

    def __init__(self, cell: Workcell, node: str, name: str, classes: Sequence[NodeClass]) -> None:
        super().__init__(cell, node, name, classes)
        if self.info.read_only:
            raise OSError(errno.EACCES, f"{type(self).__name__} of {node}: it can only be read")
        if len(self.info.channels) != 1:
            names = ", ".join(f"{node}.{channel.name}" for channel in self.info.channels)
            text = f"{type(self).__name__} of {node}: it has {len(self.info.channels)} channels; want one of {names}"
            raise OSError(errno.EINVAL, text)
        self._lock = threading.RLock()
        self._staged = False
        self._output: Any = None

    @property
    def is_held(self) -> bool:
        """Whether it is held."""
        return self._output is not None

    def take(self) -> Any:
        """Take the output, unless it is held already.

        Raises:
            OSError: EBUSY, another holds it.
        """
        with self._lock:
            if self._output is None:
                self._output = self.cell.open(self.node_name, "rw", lease=LEASE_S)
                threading.Thread(target=self._beat, args=[self._output], name="lease", daemon=True).start()
            return self._output

    def release(self) -> None:
        """Let go of it: an axis halts, an output becomes safe, and it is free for others."""
        with self._lock:
            output, self._output = self._output, None
        if output is not None:
            with suppress(OSError):
                output.close()

    def _beat(self, output: Any) -> None:
        pause = threading.Event()
        while self._output is output:
            try:
                output.keepalive()
            except OSError:
                return  # its next request says why
            pause.wait(LEASE_S / 4)

    def stage(self) -> list[Any]:
        """Take it for a run."""
        self.take()
        self._staged = True
        return [self]

    def unstage(self) -> list[Any]:
        """Let go of it."""
        self._staged = False
        self.release()
        return [self]


class Axis(Held):
    """An axis: a positioner.

    Args:
        cell: the session.
        node: of one axis, as ``mod0.xaxis``.
        name: in documents; '': that of the node. Beside the position there is ``NAME_setpoint``.

    Example:
        ``RE(scan([Detector(cell, "lord1")], Axis(cell, "mod0.xaxis"), 0, 0.1, 11))``
    """

    def __init__(self, cell: Workcell, node: str, name: str = "") -> None:
        super().__init__(cell, node, name, [NodeClass.AXIS])
        self._moving = 0
        self._stopped: bool | None = None

    @property
    def position(self) -> float:
        """Where it is [unit of the axis]."""
        return float(self.readings.read().position[0])

    def check_value(self, value: float) -> None:
        """See whether a position is within the limits.

        Raises:
            ValueError: it is not.
        """
        about = self.info.channels[0]
        low = -float("inf") if about.minimum is None else about.minimum
        high = float("inf") if about.maximum is None else about.maximum
        if not low <= value <= high:
            raise ValueError(f"{self.name}: {value:g} {about.unit}; want {low:g} to {high:g} {about.unit}")

    def set(self, value: float) -> Status:
        """Go to a position, instead of what it does; the status is done when it is there."""
        node = self.take()
        self._stopped = None
        try:
            node.move(float(value), replace=True)
        except OSError:
            self._let_go()
            raise

        def wait() -> None:
            try:
                node.wait_until_idle()
            except OSError:
                if not self._stopped:  # a stop that was meant is no failure
                    raise
            finally:
                if self._moving == number:
                    self._let_go()

        self._moving = number = self._moving + 1
        return begin(f"move {self.name} to {value:g}", wait)

    def _let_go(self) -> None:
        """Let go of it unless it is staged: what held it was the motion."""
        if not self._staged:
            self.release()

    def stop(self, success: bool = True) -> None:
        """Stop it at maximum deceleration; what was under way has succeeded or failed by that."""
        self._stopped = success
        with self._lock:
            if self._output is not None:
                self._output.stop()

    def locate(self) -> dict[str, float]:
        """Return where it shall be, and where it is."""
        now = self.readings.read()
        return {"setpoint": now.commanded_position[0], "readback": now.position[0]}

    def describe(self) -> dict[str, Any]:
        """Describe position and set-point."""
        return super().describe() | {f"{self.name}_setpoint": self.described(0, "commanded_position")}

    def told(self, snapshot: Any) -> dict[str, Any]:
        """Return position and set-point."""
        found = super().told(snapshot)
        stamp_s = found[self.name]["timestamp"]
        return found | {f"{self.name}_setpoint": {"value": snapshot.commanded_position[0], "timestamp": stamp_s}}


class Output(Held):
    """A bit, a port or an analog output: held from the first value on until ``unstage`` or ``release``, then safe.

    Args:
        cell: the session.
        node: of one channel, as ``gripper0.bit0``.
        name: in documents; '': that of the node.
    """

    def __init__(self, cell: Workcell, node: str, name: str = "") -> None:
        super().__init__(cell, node, name, [NodeClass.BINARY, NodeClass.ANALOG])

    def set(self, value: float) -> Status:
        """Write a value; it is done when the driver has taken it."""
        node = self.take()
        status = Status(f"set {self.name} to {value}")
        node.set(int(value) if self.info.node_class is NodeClass.BINARY else float(value))
        status.finish()
        return status
