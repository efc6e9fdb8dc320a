"""Lines of a Linux GPIO chip (character device), through the Python binding of libgpiod 2: the package ``gpiod``.

Input lines are one port; every edge is published with the kernel's time stamp, also those that fell into one tick.
Output lines are another; they take their safe levels when the driver opens and before it lets go of them. The kernel
gives the lines back when
the process dies: what level they then have is the board's matter, so a line that must fall needs a resistor that pulls
    it.

    [device.io0]
    driver = "gpio"
    chip = "/dev/gpiochip0"
    [[device.io0.input]]
    line = "START"
    bias = "pull_up"
    active_low = true
    debounce_s = 0.005
    [[device.io0.output]]
    line = 27
    safe = 0
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import timedelta
from typing import Any, Literal

import msgspec

from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnyBlock, BinaryBlock, BlockSpec, Description
from sioms.sdk.driver import Kit, Refusal, TickDriver
from sioms.sdk.exchange import LinkError

from .chip import GpioChip, load_binding
from .edges import Edge, EdgePort

LINES = 62
"""Most lines of a port: bits of a binary channel."""
BUFFER_MOST = 1024
"""Most edges that the kernel keeps for a request (GPIO_V2_LINES_MAX * 16)."""


class InputTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An input line.

    Attributes:
        line: its offset in the chip, or its name.
        bias: the resistor inside; "as_is" leaves it.
        active_low: a low level reads as 1.
        debounce_s: a level counts when it has stood for this long [s]; done by the kernel or the chip.
    """

    line: int | str
    bias: Literal["as_is", "disabled", "pull_up", "pull_down"] = "as_is"
    active_low: bool = False
    debounce_s: float = 0.0


class OutputTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An output line.

    Attributes:
        line: its offset in the chip, or its name.
        safe: its value when the driver opens and ends, its writer goes away or the workcell stops.
        drive: how the pin is driven.
        bias: the resistor inside.
        active_low: 1 is a low level.
    """

    line: int | str
    safe: Literal[0, 1] = 0
    drive: Literal["push_pull", "open_drain", "open_source"] = "push_pull"
    bias: Literal["as_is", "disabled", "pull_up", "pull_down"] = "as_is"
    active_low: bool = False


class GpioSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device.

    Attributes:
        chip: path of the chip's device.
        input: lines of the input port, bit 0 first.
        output: lines of the output port, bit 0 first.
        tick_hz: rate at which the edges are fetched; their stamps do not depend on it.
        event_buffer: edges that the kernel keeps between two ticks.
        history: snapshots kept for readers; each edge is one.
    """

    chip: str
    input: list[InputTable] = []
    output: list[OutputTable] = []
    tick_hz: float = 500.0
    event_buffer: int = BUFFER_MOST
    history: int = 1024


class Gpio(TickDriver):
    """Some lines of one chip.

    Attributes:
        binding: gives the module of libgpiod's binding.

    Concurrency: the one thread of the driver process.
    """

    Settings = GpioSettings
    binding: Callable[[], Any] = staticmethod(load_binding)

    @classmethod
    def describe(cls, name: str, settings: GpioSettings) -> Description:
        """Tell the ports; raises ValueError for lines that cannot be, and when the binding is missing."""
        _check(settings)
        cls.binding()
        ports = []
        if settings.output:
            safe = sum(table.safe << bit for bit, table in enumerate(settings.output))
            channel = _channel("out", [table.line for table in settings.output])
            ports.append(BlockSpec("", NodeClass.BINARY, (channel,), True, settings.history, safe=(float(safe),)))
        if settings.input:
            channel = _channel("in", [table.line for table in settings.input])
            own = "in" if settings.output else ""
            ports.append(BlockSpec(own, NodeClass.BINARY, (channel,), history=settings.history))
        return Description(tuple(ports), settings.tick_hz, lease_s=max(0.1, 5 / settings.tick_hz))

    @classmethod
    def claims(cls, settings: GpioSettings) -> Sequence[str]:
        """Return the lines; the kernel gives each to one only."""
        chip = os.path.realpath(settings.chip)
        lines = [table.line for table in settings.output] + [table.line for table in settings.input]
        return [f"line {line} of {chip}" for line in lines]

    def __init__(self, name: str, settings: GpioSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self._gpiod = self.binding()
        self._blocks = [BinaryBlock(spec) for spec in self.describe(name, settings).blocks]
        self._inputs: Any = None
        self._outputs: Any = None
        self._bits: dict[int, int] = {}
        self._pins: list[int] = []
        self._port = EdgePort(0)
        self._told = 0

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The ports."""
        return self._blocks

    def open(self) -> None:
        """Request the lines, outputs at their safe levels first."""
        self._release()
        settings = self.settings
        try:
            with GpioChip(self._gpiod, settings.chip) as chip:
                pins = [chip.offset(table.line) for table in settings.output]
                keys = [chip.offset(table.line) for table in settings.input]
                if twice := {offset for offset in pins + keys if (pins + keys).count(offset) > 1}:
                    raise LinkError(f"open {settings.chip}: line {twice.pop()} is configured by name and by offset")
                whose = f"sioms {self.name}", settings.event_buffer
                if pins:
                    lines = dict(zip(pins, map(self._output, settings.output), strict=True))
                    self._outputs = chip.request(lines, *whose)
                if keys:
                    lines = dict(zip(keys, map(self._input, settings.input), strict=True))
                    self._inputs = chip.request(lines, *whose)
        except LinkError:
            self._release()
            raise
        self._pins, self._bits = pins, {offset: bit for bit, offset in enumerate(keys)}
        now_ns = time.monotonic_ns()
        if self._outputs is not None:
            self._blocks[0].set(0, self._safe(), now_ns)
        if self._inputs is not None:
            self._port, self._told = EdgePort(self._levels()), 0
            self._blocks[-1].set(0, self._port.value, now_ns)

    def tick(self, now_ns: int) -> None:
        """Publish the edges since the last tick one by one; the kit publishes the last."""
        edges = self._fetch()
        if not edges:
            return
        block, values = self._blocks[-1], self._port.take(edges)
        block.count_lost(0, self._port.lost - self._told)
        for index, (value, stamp_ns) in enumerate(values):
            if index:
                self.kit.publish(block, now_ns)
            block.set(0, value, stamp_ns)
        if self._port.lost != self._told:
            self._tell_loss(block, now_ns)

    def write_outputs(self, block: BlockSpec, channels: Sequence[int], values: Sequence[float]) -> None:
        """Set all outputs in one call."""
        value = int(values[-1])
        levels = self._gpiod.line.Value
        if self._outputs is None:
            raise Refusal(errno.EIO, f"the lines of {self.settings.chip} are not open")
        try:
            self._outputs.set_values({pin: levels(value >> bit & 1) for bit, pin in enumerate(self._pins)})
        except OSError as error:
            raise Refusal(error.errno or errno.EIO, f"set lines of {self.settings.chip}: {error.strerror}") from None
        self._blocks[0].set(0, value, time.monotonic_ns())

    def counters(self) -> Mapping[str, int]:
        """Return what came of the edges."""
        return {"edges": self._port.seen, "lost_edges": self._port.lost}

    def close(self) -> None:
        """Set the safe levels, then let go: after that the level is not ours to say."""
        if self._outputs is not None:
            try:
                self.write_outputs(self._blocks[0].spec, [0], [self._safe()])
            except Refusal as error:  # unplugged: nobody can set them any more
                self.kit.log("error", f"{self.name}: safe outputs could not be set: {error}")
        self._release()

    # --- inside ----------------------------------------------------------------------------------

    def _safe(self) -> int:
        return sum(table.safe << bit for bit, table in enumerate(self.settings.output))

    def _release(self) -> None:
        for request in (self._outputs, self._inputs):
            if request is not None:
                request.release()
        self._outputs = self._inputs = None

    def _input(self, table: InputTable) -> Any:
        words = self._gpiod.line
        return self._gpiod.LineSettings(
            direction=words.Direction.INPUT, edge_detection=words.Edge.BOTH, bias=words.Bias[table.bias.upper()],
            active_low=table.active_low, debounce_period=timedelta(seconds=table.debounce_s),
            event_clock=words.Clock.MONOTONIC,
        )  # fmt: skip

    def _output(self, table: OutputTable) -> Any:
        words = self._gpiod.line
        return self._gpiod.LineSettings(
            direction=words.Direction.OUTPUT,
            bias=words.Bias[table.bias.upper()],
            drive=words.Drive[table.drive.upper()],
            active_low=table.active_low,
            output_value=words.Value(table.safe),
        )

    def _edge(self, event: Any) -> Edge:
        rising = event.event_type is event.Type.RISING_EDGE
        return Edge(self._bits[event.line_offset], rising, event.timestamp_ns, event.global_seqno)

    def _fetch(self) -> list[Edge]:
        """Return the edges that the kernel has kept.

        Raises:
            LinkError: the chip is gone.
        """
        edges: list[Edge] = []
        try:
            # a request of outputs has no edges: it becomes readable when its chip is gone, and says so then
            for request in (self._outputs, self._inputs):
                while request is not None and request.wait_edge_events(0):
                    edges += map(self._edge, request.read_edge_events(self.settings.event_buffer))
        except OSError as error:
            raise LinkError(f"read lines of {self.settings.chip}: {(error.strerror or str(error)).lower()}") from None
        return edges

    def _levels(self) -> int:
        values = self._inputs.get_values(list(self._bits))
        return sum(int(level.value) << bit for bit, level in enumerate(values))

    def _tell_loss(self, block: BinaryBlock, now_ns: int) -> None:
        """Say how many edges were lost, and read the levels that they may have left behind."""
        lost, self._told = self._port.lost - self._told, self._port.lost
        text = f"{self.name}: {lost} edges lost; want a higher tick_hz, a longer debounce_s, or a calmer line"
        self.kit.log("warning", text)
        if self._port.correct(self._levels()):
            self.kit.publish(block, now_ns)
            block.set(0, self._port.value, now_ns)


def _channel(name: str, lines: Sequence[int | str]) -> ChannelInfo:
    about = ", ".join(f"bit{bit} {'line ' if isinstance(line, int) else ''}{line}" for bit, line in enumerate(lines))
    return ChannelInfo(name, minimum=0, maximum=2 ** len(lines) - 1, width=len(lines), description=about)


def _check(settings: GpioSettings) -> None:
    """Refuse what no request could be made of."""
    if not settings.input and not settings.output:
        raise ValueError("input and output: none given; want a table [[...input]] or [[...output]] for each line")
    for kind, tables in (("input", settings.input), ("output", settings.output)):
        if len(tables) > LINES:
            raise ValueError(
                f"{kind}: {len(tables)} lines; want at most {LINES} in a port, and another device for more"
            )
    lines = [table.line for table in settings.input] + [table.line for table in settings.output]
    for line in lines:
        if lines.count(line) > 1:
            raise ValueError(f"line = {line!r} is given {lines.count(line)} times; want each once")
        if isinstance(line, int) and line < 0:
            raise ValueError(f"line = {line}; want an offset from 0, or a name")
    for table in settings.input:
        if not 0 <= table.debounce_s <= 4000:
            raise ValueError(f"line {table.line!r}: debounce_s = {table.debounce_s:g}; want 0 to 4000")
    if not 1 <= settings.tick_hz <= 10_000:
        raise ValueError(f"tick_hz = {settings.tick_hz:g}; want 1 to 10000")
    if not 1 <= settings.event_buffer <= BUFFER_MOST:
        raise ValueError(f"event_buffer = {settings.event_buffer}; want 1 to {BUFFER_MOST}")
