"""Binary and analog I/O on Modbus, each family described by a register map: Moxa ioLogik E1200, WAGO 750.

All bits of one kind are one port. Outputs are one block, inputs another, analog values one each; the first of them that
exists in the order of the map bears the device's own name unless ``main`` names another.

    [device.io0]
    driver = "modbus-io"
    map = "moxa_e1200"
    model = "E1212"
    line = { tcp = "192.168.0.20:502" }
    safe = { do = 0 }
"""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, AnyBlock, BinaryBlock, BlockSpec, Description
from sioms.sdk.codec import modbus_pdu
from sioms.sdk.driver import Kit, LineDriver, LineUnit
from sioms.sdk.exchange import DeviceError, Steps
from sioms.sdk.golden import Golden
from sioms.sdk.line import ATTEMPTS
from sioms.sdk.settings import LineSettings
from sioms.wording import did_you_mean

from .guard import Guard
from .registers import UNITS, to_words, width
from .regmap import Port, RegisterMap, Signal
from .regmap_files import named_map
from .unit import MappedUnit, golden_of, unit_on

MAPS = Path(__file__).parent / "maps"
LOST_S = 0.5
"""A block that is silent for so long is lost [s]: inputs that stop the workcell must not be blind for longer."""


class ModbusIoSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device.

    Attributes:
        map: name of a shipped register map, or the path of a file.
        line: the line that the block is on.
        model: type of the block, where the map knows models.
        channels: number of channels of each port of the map, where it does not.
        address: Modbus unit.
        safe: value of an output port when its writer goes away or the workcell stops; without it the outputs stay.
        main: port that bears the device's own name.
        poll_hz: rate of reading.
        watchdog_s: time-out of the device's own watchdog [s], where the map can set it; 0 leaves it alone.
        history: snapshots kept for readers.
        override: keys put over the map's.
    """

    map: str
    line: LineSettings
    model: str = ""
    channels: dict[str, int] = {}
    address: int = 1
    safe: dict[str, float] = {}
    main: str = ""
    poll_hz: float = 100.0
    watchdog_s: float = 0.0
    history: int = 64
    override: dict[str, Any] = {}


@dataclass(frozen=True, slots=True)
class PortPlan:
    """A port that the device has: its map, its signal and its block."""

    port: Port
    signal: Signal
    count: int
    spec: BlockSpec


class ModbusIo(LineDriver):
    """An I/O block on a line.

    Concurrency: the one thread of the driver process.
    """

    Settings = ModbusIoSettings

    @classmethod
    def describe(cls, name: str, settings: ModbusIoSettings) -> Description:
        """Tell the ports; raises ValueError for a model or a number of channels that cannot be."""
        if not 0.1 <= settings.poll_hz <= 1000:
            raise ValueError(f"poll_hz = {settings.poll_hz:g}; want 0.1 to 1000")
        plans = _plan(_load(settings), settings)
        unit_on(settings.line, settings.address, 1.0)
        return Description(tuple(plan.spec for plan in plans), settings.poll_hz, lease_s=max(0.5, 5 / settings.poll_hz))

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return the golden frames of the register map."""
        return golden_of(_load(settings)) if settings is not None else ()

    def __init__(self, name: str, settings: ModbusIoSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        rmap = _load(settings)
        self.line = settings.line
        self.gap_s = rmap.gap_s
        if settings.line.serial is not None:
            baud = settings.line.baud
            characters = 3.5 * settings.line.bits_per_character
            self.gap_s = max(rmap.gap_s, 0.00175 if baud > 19200 else characters / baud)
        self.recovery_s = rmap.turnaround_s if settings.line.serial is not None else 0.0
        self._units = [IoUnit(name, rmap, settings, _plan(rmap, settings), kit.log)]

    @property
    def units(self) -> Sequence[LineUnit]:
        """The one unit."""
        return self._units


def _load(settings: ModbusIoSettings) -> RegisterMap:
    rmap = named_map(settings.map, MAPS, settings.override)
    if not rmap.ports:
        raise ValueError(f"map = {settings.map}: describes no ports; want a map of an I/O block")
    if settings.watchdog_s and "watchdog" not in rmap.commands:
        raise ValueError(f"watchdog_s = {settings.watchdog_s:g}: the map cannot set one; want 0")
    return rmap


def _counts(rmap: RegisterMap, settings: ModbusIoSettings) -> Mapping[str, int]:
    """Return port to number of channels."""
    counts: dict[str, int] = {}
    if settings.model:
        if settings.model not in rmap.models:
            raise ValueError(f"model = {settings.model}: not in the map{did_you_mean(settings.model, rmap.models)}")
        counts |= rmap.models[settings.model]
    elif rmap.models and not settings.channels:
        raise ValueError(f"model: none given; want one of {', '.join(rmap.models)}")
    counts |= settings.channels
    for port, count in counts.items():
        if port not in rmap.ports:
            raise ValueError(f"channels.{port}: no such port{did_you_mean(port, rmap.ports)}")
        most = rmap.signals[rmap.ports[port].signal].count
        if not 0 <= count <= most:
            raise ValueError(f"channels.{port} = {count}; want 0 to {most}")
    return {port: count for port, count in counts.items() if count}


def _plan(rmap: RegisterMap, settings: ModbusIoSettings) -> tuple[PortPlan, ...]:
    counts = _counts(rmap, settings)
    if not counts:
        raise ValueError("channels: none; want the number of channels of one port at least")
    for port in settings.safe:
        if port not in counts or not rmap.ports[port].writable:
            writable = [each for each in counts if rmap.ports[each].writable]
            raise ValueError(f"safe.{port}: no output of this device{did_you_mean(port, writable)}")
    if settings.main and settings.main not in counts:
        raise ValueError(f"main = {settings.main}: no port of this device{did_you_mean(settings.main, counts)}")
    main = settings.main or next(iter(counts))
    return tuple(_port_plan(rmap, settings, port, counts[port], port == main) for port in counts)


def _port_plan(rmap: RegisterMap, settings: ModbusIoSettings, name: str, count: int, main: bool) -> PortPlan:
    port = rmap.ports[name]
    signal = rmap.signals[port.signal]
    shown = port.name or name
    safe = settings.safe.get(name)
    if port.node_class == "binary":
        channels: tuple[ChannelInfo, ...] = (
            ChannelInfo(shown, minimum=0, maximum=2**count - 1, width=count, description=rmap.title),
        )
        if safe is not None and not (0 <= safe < 2**count and safe == int(safe)):
            raise ValueError(f"safe.{name} = {safe:g}; want an integer from 0 to {2**count - 1}")
    else:
        unit = UNITS[signal.unit].si
        channels = tuple(
            ChannelInfo(f"{shown}{i}", unit, port.minimum, port.maximum, description=rmap.title) for i in range(count)
        )
    spec = BlockSpec(
        "" if main else shown,
        NodeClass.BINARY if port.node_class == "binary" else NodeClass.ANALOG,
        channels,
        writable=port.writable,
        history=settings.history,
        safe=(safe,) * len(channels) if port.writable else (),
    )
    return PortPlan(port, signal, count, spec)


class IoUnit(LineUnit):
    """The block of inputs and outputs.

    Args:
        name: of the device.
        rmap: its register map.
        settings: its configuration.
        plans: its ports.
        log: takes a level and a sentence.

    Attributes:
        clock: the time [ns, CLOCK_MONOTONIC].
    """

    def __init__(
        self,
        name: str,
        rmap: RegisterMap,
        settings: ModbusIoSettings,
        plans: Sequence[PortPlan],
        log: Callable[[str, str], None],
    ) -> None:
        self.name = name
        self.clock = time.monotonic_ns
        # on a serial line a silence follows each time-out
        failed_s = ATTEMPTS * rmap.turnaround_s * (2 if settings.line.serial is not None else 1)
        self.misses = max(1, int(LOST_S / failed_s))
        self._settings, self._plans = settings, plans
        unit = unit_on(settings.line, settings.address, rmap.turnaround_s)
        counts = {plan.port.signal: plan.count for plan in plans}
        self._mapped = MappedUnit(rmap, unit, None, name, counts)
        self._guard = Guard(self._mapped, settings.watchdog_s, log)
        self._reads = self._mapped.plan(plan.port.signal for plan in plans)
        self._blocks = [
            BinaryBlock(plan.spec) if plan.spec.node_class is NodeClass.BINARY else AnalogBlock(plan.spec)
            for plan in plans
        ]

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The ports."""
        return self._blocks

    def open(self) -> Steps:
        """Clear a watchdog that has acted, identify the block, set its watchdog and see that it runs."""
        yield from self._guard.clear()
        yield from self._mapped.identify({"model": self._settings.model})
        yield from self._guard.open()

    def poll(self) -> Steps:
        """Read all ports and see that the watchdog still runs; the stamp is the time of the last reply of the ports."""
        values = yield from self._mapped.read(self._reads)
        now_ns = self.clock()
        yield from self._guard.poll(now_ns)
        for plan, block in zip(self._plans, self._blocks, strict=True):
            value = values[plan.port.signal]
            block.stamp_ns = now_ns
            if isinstance(block, BinaryBlock):
                block.set(0, int(value), now_ns)
            else:
                block.data[:] = value
                block.flags[:] = 0
                self._flag_ends(plan, block)

    def write_outputs(self, block: BlockSpec, channels: Sequence[int], values: Sequence[float]) -> Steps:
        """Write outputs, confirmed by the device."""
        plan = next(plan for plan in self._plans if plan.spec.name == block.name)
        if plan.spec.node_class is NodeClass.BINARY:
            bits = int(values[-1])
            pdu = modbus_pdu.write_coils(plan.signal.address, plan.count, bits)
            yield from self._mapped.write(pdu)
            return
        for channel, value in zip(channels, values, strict=True):
            yield from self._mapped.write(self._analog(plan, channel, value))

    def _analog(self, plan: PortPlan, channel: int, value: float) -> modbus_pdu.Pdu:
        signal = plan.signal
        raw = self._mapped.gearing.from_si(value, UNITS[signal.unit], signal.scale, signal.offset)
        order = signal.word_order or self._mapped.rmap.word_order
        try:
            words = to_words(raw if signal.type == "f32" else round(raw), signal.type, order)
        except ValueError as error:
            raise DeviceError(errno.ERANGE, f"write channel {channel} of {self.name}: {value:g}: {error}") from None
        return modbus_pdu.write_registers(signal.address + channel * width(signal.type), words)

    def _flag_ends(self, plan: PortPlan, block: AnalogBlock) -> None:
        """Mark values at the ends of an unsigned converter: the true value may lie beyond."""
        if plan.signal.type == "u16" and not plan.port.writable:
            full = self._mapped.gearing.to_si(0xFFFF, UNITS[plan.signal.unit], plan.signal.scale, plan.signal.offset)
            block.flags[block.data >= full] = int(AnalogStatus.SATURATED)
