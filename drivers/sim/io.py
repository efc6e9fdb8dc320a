"""Simulated binary inputs and outputs: gripper, light beams tied to axes, square waves, loop-backs.

Outputs are one writable port under the device's own name; inputs are one port, named ``in`` when
there are outputs too. Edges of inputs carry the instant at which they happened, finer than the tick,
and each is published on its own, so that none is lost however short.

    [device.beams]
    driver = "sim-io"
    inputs = 3
    [[device.beams.beam]]
    bit = 0
    boxes = [{ "mod0.plant.xaxis_position" = [0.10, 0.14], "mod0.plant.zaxis_position" = [-0.05, -0.01] }]
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import msgspec
from msgspec import Meta

from sioms.plant.binary import Beam, Box, Edge, Gripper, SquareWave, port_values
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnyBlock, BinaryBlock, BlockSpec, Description
from sioms.sdk.driver import Kit, TickDriver

Bit = Annotated[int, Meta(ge=0, le=61)]
Width = Annotated[int, Meta(ge=0, le=62)]
Seconds = Annotated[float, Meta(ge=0, le=1e6)]


class BeamTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A light beam on an input bit: 1 while broken.

    Attributes:
        bit: of the inputs.
        boxes: each a table of node to [low, high]: broken while all nodes of a box lie within.
    """

    bit: Bit
    boxes: list[dict[str, tuple[float, float]]]


class GripperTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Jaws that close while their output bit is 1.

    Attributes:
        bit: of the outputs.
        closed_bit, opened_bit: end switches, of the inputs.
        delay_s: from output to first motion.
        travel_s: for the whole way.
        object_at: opening at which an object stops the jaws, 0 for none.
    """

    bit: Bit
    closed_bit: Bit
    opened_bit: Bit
    delay_s: Seconds = 0.02
    travel_s: Seconds = 0.15
    object_at: float = 0.0


class WaveTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A square wave on an input bit, a stimulus for measurements.

    Attributes:
        bit: of the inputs.
        period_s, high_s: of the wave.
        count: number of periods, 0 for no end.
        trigger_bit: output bit whose rise starts the wave and whose fall ends it; it runs always when absent.
    """

    bit: Bit
    period_s: Annotated[float, Meta(ge=1e-6, le=1e6)]
    high_s: Seconds
    count: Annotated[int, Meta(ge=0)] = 0
    trigger_bit: Bit | None = None


class LoopTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A wire from an output to an input bit."""

    bit: Bit
    output_bit: Bit


class SimIoSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device.

    Attributes:
        outputs, inputs: number of bits.
        safe: outputs when their writer goes away or the workcell stops; they stay when absent.
        beam, gripper, wave, loop: what is wired to them.
        tick_hz: rate.
        history: snapshots kept for readers.
    """

    outputs: Width = 0
    inputs: Width = 0
    safe: int | None = None
    beam: list[BeamTable] = []
    gripper: list[GripperTable] = []
    wave: list[WaveTable] = []
    loop: list[LoopTable] = []
    tick_hz: float = 1000.0
    history: int = 256


class SimIo(TickDriver):
    """Simulated binary inputs and outputs.

    Concurrency: the one thread of the driver process.
    """

    Settings = SimIoSettings
    realtime_priority = 0

    @classmethod
    def describe(cls, name: str, settings: SimIoSettings) -> Description:
        """Tell the ports, and the nodes that the beams look at."""
        _check(settings)
        ports = []
        if settings.outputs:
            safe = None if settings.safe is None else float(settings.safe)
            channel = ChannelInfo("out", minimum=0, maximum=2**settings.outputs - 1, width=settings.outputs)
            ports.append(BlockSpec("", NodeClass.BINARY, (channel,), True, settings.history, safe=(safe,)))
        if settings.inputs:
            channel = ChannelInfo("in", minimum=0, maximum=2**settings.inputs - 1, width=settings.inputs)
            ports.append(
                BlockSpec("in" if settings.outputs else "", NodeClass.BINARY, (channel,), history=settings.history)
            )
        return Description(tuple(ports), settings.tick_hz, tuple(_nodes(settings)), lease_s=1.0)

    def __init__(self, name: str, settings: SimIoSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        blocks = [BinaryBlock(spec) for spec in self.describe(name, settings).blocks]
        self._blocks = blocks
        self._outputs = blocks[0] if settings.outputs else None
        self._inputs = blocks[-1] if settings.inputs else None
        self._wanted: list[int] = []
        self._nodes = _nodes(settings)
        self._beams = [(table.bit, Beam(_boxes(table, self._nodes))) for table in settings.beam]
        self._grippers = [
            (table, Gripper(round(table.delay_s * 1e9), round(table.travel_s * 1e9), table.object_at))
            for table in settings.gripper
        ]
        self._waves: dict[int, SquareWave] = {}
        self._positions: dict[int, float] = {}
        self._seen_ns = 0
        self._last_ns = 0

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The ports."""
        return self._blocks

    def write_outputs(self, block: BlockSpec, channels: Sequence[int], values: Sequence[float]) -> None:
        """Take the outputs; they are set in the next tick, one write after the other."""
        self._wanted.append(int(values[-1]))

    def tick(self, now_ns: int) -> None:
        """Set the outputs, find the edges of the inputs since the last tick, publish them one by one."""
        wanted, self._wanted = self._wanted, []
        if self._outputs is not None:
            for index, value in enumerate(wanted):
                if index:  # each write is an edge of its own, also where its outputs are wired to
                    self.kit.publish(self._outputs, now_ns)
                    if self._inputs is not None:
                        self._show(self._inputs, self._loop_edges(now_ns), now_ns)
                        self.kit.publish(self._inputs, now_ns)
                self._drive(self._outputs, value, now_ns)
        edges = self._wave_edges(now_ns) + self._beam_edges(now_ns) + self._gripper_edges(now_ns)
        edges += self._loop_edges(now_ns)
        self._last_ns = now_ns
        if self._inputs is not None:
            self._show(self._inputs, edges, now_ns)

    def is_at_rest(self) -> bool:
        """Whether no edge can come by itself: outputs are set, jaws rest, and there are neither waves nor beams."""
        settled = all(gripper.is_at_rest for _, gripper in self._grippers)
        return settled and not (self._wanted or self._waves or self._beams)

    def _drive(self, port: BinaryBlock, wanted: int, now_ns: int) -> None:
        rising = wanted & ~int(port.data[0])
        falling = ~wanted & int(port.data[0])
        port.set(0, wanted, now_ns)
        for table, gripper in self._grippers:
            gripper.command(bool(wanted >> table.bit & 1), now_ns)
        for table in self.settings.wave:
            if table.trigger_bit is not None and rising >> table.trigger_bit & 1:
                self._waves[table.bit] = _wave(table, now_ns)
            elif table.trigger_bit is not None and falling >> table.trigger_bit & 1:
                self._waves.pop(table.bit, None)

    def _show(self, port: BinaryBlock, edges: list[tuple[Edge, int]], now_ns: int) -> None:
        """Set the port edge by edge; all but the last are published at once, so that none is lost."""
        for index, (stamp_ns, value) in enumerate(port_values(int(port.data[0]), edges)):
            if index:
                self.kit.publish(port, now_ns)
            port.set(0, value, stamp_ns)

    def _wave_edges(self, now_ns: int) -> list[tuple[Edge, int]]:
        edges: list[tuple[Edge, int]] = []
        for table in self.settings.wave:
            if table.trigger_bit is None and table.bit not in self._waves:
                self._waves[table.bit] = _wave(table, now_ns)
            wave = self._waves.get(table.bit)
            if wave is None:
                # Ended by its trigger: low from now on.
                edges.append((Edge(now_ns, False), table.bit))
            else:
                edges += [(edge, table.bit) for edge in wave.edges(self._last_ns, now_ns)]
        return edges

    def _beam_edges(self, now_ns: int) -> list[tuple[Edge, int]]:
        """Sample the beams at every snapshot of the nodes, at the nodes' own time: a late tick misses none.

        Where it is so late that snapshots have been overwritten, edges are counted as lost.
        """
        if not self._beams:
            return []
        news: dict[int, dict[int, float]] = {}
        for index, node in enumerate(self._nodes):
            source = self.kit.inputs[node]
            fresh = [(stamp_ns, float(reading["value"][0])) for stamp_ns, reading in source.fresh(now_ns)]
            for stamp_ns, position in fresh:
                news.setdefault(stamp_ns, {})[index] = position
            moved = fresh and fresh[0][1] != self._positions.get(index, fresh[0][1])
            if source.missed and moved and self._inputs is not None:  # whether it came and went, nobody can tell
                self._inputs.count_lost(0, 2)
        edges = []
        for stamp_ns in sorted(news):
            self._positions.update(news[stamp_ns])
            if len(self._positions) == len(self._nodes) and stamp_ns > self._seen_ns:
                self._seen_ns = stamp_ns
                positions = [self._positions[index] for index in range(len(self._nodes))]
                edges += [(edge, bit) for bit, beam in self._beams for edge in beam.sample(positions, stamp_ns)]
        return edges

    def _gripper_edges(self, now_ns: int) -> list[tuple[Edge, int]]:
        edges: list[tuple[Edge, int]] = []
        for table, gripper in self._grippers:
            if self._last_ns == 0:
                edges.append((Edge(now_ns, gripper.opened), table.opened_bit))
            closed, opened = gripper.sample(now_ns)
            edges += [(edge, table.closed_bit) for edge in closed]
            edges += [(edge, table.opened_bit) for edge in opened]
        return edges

    def _loop_edges(self, now_ns: int) -> list[tuple[Edge, int]]:
        value = 0 if self._outputs is None else int(self._outputs.data[0])
        return [(Edge(now_ns, bool(value >> t.output_bit & 1)), t.bit) for t in self.settings.loop]


def _wave(table: WaveTable, start_ns: int) -> SquareWave:
    """Return the wave, its first rise in the tick after the start."""
    return SquareWave(round(table.period_s * 1e9), round(table.high_s * 1e9), start_ns + 1, table.count)


def _nodes(settings: SimIoSettings) -> list[str]:
    """Return the nodes that the beams look at, each once."""
    return list(dict.fromkeys(node for beam in settings.beam for box in beam.boxes for node in box))


def _boxes(table: BeamTable, nodes: Sequence[str]) -> list[Box]:
    return [Box(tuple((nodes.index(node), low, high) for node, (low, high) in box.items())) for box in table.boxes]


def _check(settings: SimIoSettings) -> None:
    """Refuse bits that are not there or are driven twice.

    Raises:
        ValueError: with the bit and what would be right.
    """
    if not settings.outputs and not settings.inputs:
        raise ValueError("outputs and inputs are both 0; want at least one bit")
    driven = [beam.bit for beam in settings.beam] + [wave.bit for wave in settings.wave]
    driven += [loop.bit for loop in settings.loop]
    driven += [bit for t in settings.gripper for bit in (t.closed_bit, t.opened_bit)]
    used = [t.bit for t in settings.gripper] + [t.output_bit for t in settings.loop]
    used += [t.trigger_bit for t in settings.wave if t.trigger_bit is not None]
    for kind, bits, width in (("input", driven, settings.inputs), ("output", used, settings.outputs)):
        for bit in bits:
            if bit >= width:
                raise ValueError(f"{kind} bit {bit} is used but there are {width}; want {kind}s = {bit + 1} or more")
    for bit in driven:
        if driven.count(bit) > 1:
            raise ValueError(f"input bit {bit} is driven {driven.count(bit)} times; want one source for a bit")
    if settings.safe is not None and not 0 <= settings.safe < 2**settings.outputs:
        raise ValueError(f"safe = {settings.safe}; want 0 to {2**settings.outputs - 1}")
    for wave in settings.wave:
        if not 0 < wave.high_s < wave.period_s:
            raise ValueError(f"wave on bit {wave.bit}: high_s {wave.high_s:g} of period_s {wave.period_s:g}; want less")
    for beam in settings.beam:
        for low, high in (interval for box in beam.boxes for interval in box.values()):
            if not low <= high:
                raise ValueError(f"beam on bit {beam.bit}: interval {low:g} to {high:g}; want low first")
    for table in settings.gripper:
        Gripper(round(table.delay_s * 1e9), round(table.travel_s * 1e9), table.object_at)


DRIVER = SimIo
