"""A driver of one's own in one file: a laboratory power supply with two outputs, on a serial line.

The supply (a made-up "PS-202") takes lines of ASCII that end in LF and answers each with one line:

    *IDN?           TERN,PS-202,00417,1.08
    MEAS?           12.003,0.501,CV;0.000,0.000,CV     voltage, current, mode of each output
    VSET 1,12.000   OK, or ERR 2 for a value out of range
    WDOG 1.0        OK; without a line for that long the outputs go to 0 V

Nodes: ``NAME`` the voltages to be set, ``NAME.meas`` what is measured, ``NAME.cc`` a bit for each output in current
    limiting.

    [device.supply0]
    driver = "./bench_supply.py"
    line = { serial = "/dev/ttyUSB0", baud = 9600 }
"""

from __future__ import annotations

import errno
import re
import time
from collections.abc import Sequence
from typing import Any

import msgspec

from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, AnyBlock, BinaryBlock, BlockSpec, Description
from sioms.sdk.driver import Kit, LineDriver, LineUnit
from sioms.sdk.exchange import DeviceError, Exchange, LinkError, Steps, until
from sioms.sdk.golden import Golden
from sioms.sdk.settings import LineSettings

# --- the codec: bytes and values, no I/O ------------------------------------------------------------

TIMEOUT_S = 0.3
line_of = until(b"\n", longest=80)
ERRORS = {1: "unknown command", 2: "value out of range", 3: "output is off"}
MEASURED = re.compile(r"(-?\d+\.\d+),(-?\d+\.\d+),(CV|CC);(-?\d+\.\d+),(-?\d+\.\d+),(CV|CC)")

Measured = tuple[tuple[float, float, bool], tuple[float, float, bool]]
"""Voltage [V], current [A] and current limiting of each output."""


def text_of(reply: bytes) -> str:
    """Return the line as text; raises DeviceError when the supply says ERR."""
    text = reply.decode("ascii", "replace").strip()
    if match := re.fullmatch(r"ERR (\d)", text):
        number = int(match[1])
        raise DeviceError(errno.EINVAL, f"the supply refuses: {ERRORS.get(number, f'error {number}')}")
    return text


def identity() -> Exchange:
    """Return the exchange that asks who it is."""
    return Exchange(b"*IDN?\n", line_of, text_of, TIMEOUT_S, True, "ask for the identity")


def measure() -> Exchange:
    """Return the exchange that reads both outputs."""

    def decode(reply: bytes) -> Measured:
        match = MEASURED.fullmatch(text_of(reply))
        if match is None:
            raise LinkError(f"read the outputs: {reply!r} is not a reading")
        u1, i1, m1, u2, i2, m2 = match.groups()
        return (float(u1), float(i1), m1 == "CC"), (float(u2), float(i2), m2 == "CC")

    return Exchange(b"MEAS?\n", line_of, decode, TIMEOUT_S, True, "read the outputs")


def order(text: str) -> Exchange:
    """Return the exchange of an order; sending it twice does no more than once, so the kit may repeat it."""

    def decode(reply: bytes) -> None:
        if text_of(reply) != "OK":
            raise LinkError(f"send {text!r}: {reply!r} does not answer it")

    return Exchange(text.encode() + b"\n", line_of, decode, TIMEOUT_S, True, f"send {text!r}")


# --- the driver -------------------------------------------------------------------------------------


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device.

    Attributes:
        line: the serial port.
        voltage_max: highest voltage that may be set [V].
        watchdog_s: the supply switches off after this time without a line [s].
        poll_hz: readings per second.
    """

    line: LineSettings
    voltage_max: float = 30.0
    watchdog_s: float = 1.0
    poll_hz: float = 10.0


class Supply(LineUnit):
    """The one unit on the line: its hooks yield exchanges and are resumed with what was decoded."""

    def __init__(self, name: str, settings: Settings) -> None:
        self.name = name
        self._watchdog_s = settings.watchdog_s
        volts, measured, limiting = BenchSupply.describe(name, settings).blocks
        self._volts, self._measured, self._limiting = (
            AnalogBlock(volts),
            AnalogBlock(measured),
            BinaryBlock(limiting),
        )

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """As described."""
        return (self._volts, self._measured, self._limiting)

    def open(self) -> Steps:
        """Refuse another device, start from 0 V, set the dead-man; runs again after every loss."""
        who = yield identity()
        if ",PS-202," not in who:
            raise DeviceError(errno.ENODEV, f"identify {self.name}: {who!r} answers; want a PS-202")
        for output in (1, 2):
            yield order(f"VSET {output},0.000")
            self._volts.data[output - 1] = 0.0
        yield order(f"WDOG {self._watchdog_s:.1f}")

    def poll(self) -> Steps:
        """Read the outputs; that also keeps the supply's watchdog quiet."""
        outputs: Measured = yield measure()
        now_ns = time.monotonic_ns()
        for block in (self._volts, self._measured, self._limiting):
            block.stamp_ns = now_ns
        self._measured.data[:] = [value for volts, amperes, _ in outputs for value in (volts, amperes)]
        self._limiting.set(0, sum(limiting << bit for bit, (_, _, limiting) in enumerate(outputs)), now_ns)

    def write_outputs(self, block: BlockSpec, channels: Sequence[int], values: Sequence[float]) -> Steps:
        """Set voltages: for a client, and 0 V when it goes away or the workcell stops."""
        for channel, value in zip(channels, values, strict=True):
            yield order(f"VSET {channel + 1},{value:.3f}")
            self._volts.data[channel] = value

    def close(self) -> Steps:
        """Leave the outputs off."""
        for output in (1, 2):
            yield order(f"VSET {output},0.000")


class BenchSupply(LineDriver):
    """The driver: what it shows, and its one unit."""

    Settings = Settings
    # for `sioms driver check`: how to run it against its simulated device
    rig = {  # noqa: RUF012
        "tables": '[device.supply]\ndriver = "./bench_supply.py"\nline = { serial = "{port}" }\npoll_hz = 50.0\n',
        "simulator": ["bench_supply_device.py"],
        "analogs": ["supply.meas"],
        "outputs": [{"node": "supply", "width": 0, "safe": 0.0, "other": 5.0}],
        "checked": False,
    }

    @classmethod
    def describe(cls, name: str, settings: Settings) -> Description:
        """Tell the blocks; pure: it runs before there is a process."""
        if not 0.5 <= settings.watchdog_s <= 60:
            raise ValueError(f"watchdog_s = {settings.watchdog_s:g}; want 0.5 to 60")
        if settings.watchdog_s * settings.poll_hz < 3:
            raise ValueError(f"poll_hz = {settings.poll_hz:g}: too slow for the watchdog; want three polls in it")
        outputs = [ChannelInfo(f"out{i}", "V", 0.0, settings.voltage_max) for i in (1, 2)]
        readings = [ChannelInfo(f"{what}{i}", unit) for i in (1, 2) for what, unit in (("u", "V"), ("i", "A"))]
        return Description(
            (
                BlockSpec("", NodeClass.ANALOG, tuple(outputs), writable=True, safe=(0.0, 0.0)),
                BlockSpec("meas", NodeClass.ANALOG, tuple(readings)),
                BlockSpec("cc", NodeClass.BINARY, (ChannelInfo("cc", minimum=0, maximum=3, width=2),)),
            ),
            settings.poll_hz,
            lease_s=max(0.5, 5 / settings.poll_hz),
        )

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return lines of the manual, and what they mean: ``sioms driver check`` tries them in every cut."""
        reading = b"12.003,0.501,CV;5.000,0.100,CC\n".hex()
        return (
            Golden(
                "identity",
                identity(),
                b"*IDN?\n".hex(),
                b"TERN,PS-202,00417,1.08\n".hex(),
                "TERN,PS-202,00417,1.08",
            ),
            Golden("reading", measure(), b"MEAS?\n".hex(), reading, ((12.003, 0.501, False), (5.0, 0.1, True))),
            Golden("set", order("VSET 1,12.000"), b"VSET 1,12.000\n".hex(), b"OK\n".hex(), None),
        )

    def __init__(self, name: str, settings: Settings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.line = settings.line
        self._units = (Supply(name, settings),)

    @property
    def units(self) -> Sequence[LineUnit]:
        """The supply."""
        return self._units


DRIVER = BenchSupply
