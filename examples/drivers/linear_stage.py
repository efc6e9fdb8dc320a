"""A driver of one's own with an axis: a linear stage that closes its own loop, on a serial line.

The stage (a made-up "LINA-2") takes lines that end in * and the sum of the characters before it, two hexadecimal
digits, and answers each with such a line:

    ID?*CC               LINA-2,1.04
    ST?*E6               I 12345 0 0: idle, moving (M) or in fault (F); position [steps], velocity [steps/s], fault
    MV 20000 5000 40000  OK, or NO 2; move to a position with a velocity and an acceleration
    RV -500 40000        OK; run at a velocity
    HA 40000             OK; halt with an acceleration
    WD 200               OK; it halts by itself after 200 ms without a line
    CE                   OK; clear the fault

    [device.stage0]
    driver = "./linear_stage.py"
    line = { serial = "/dev/ttyUSB0", baud = 115200 }
    steps_per_m = 1e6
    [[device.stage0.axis]]
    name = "x"
    velocity_max = 0.1
    acceleration_max = 1.0
    position_min = 0.0
    position_max = 0.2
"""

from __future__ import annotations

import errno
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from sioms.motion import DriveAction
from sioms.protocol.flags import ControlMode
from sioms.sdk import drive_axes
from sioms.sdk.blocks import BlockSpec, Description
from sioms.sdk.driver import Kit, LineDriver, LineUnit
from sioms.sdk.exchange import DeviceError, Exchange, LinkError, Steps, until
from sioms.sdk.golden import Golden

# --- the codec: bytes and values, no I/O ------------------------------------------------------------

TIMEOUT_S = 0.1
line_of = until(b"\n", longest=60)
REFUSALS = {1: "unknown command", 2: "number out of range", 3: "in fault; reset it"}
FAULTS = {0: "", 1: "limit switch", 2: "the motor is stalled", 3: "the motor is too hot"}
STATE = re.compile(r"([IMF]) (-?\d+) (-?\d+) (\d+)")
State = tuple[str, int, int, int]


def framed(body: str) -> bytes:
    """Return a line with its sum."""
    return f"{body}*{sum(body.encode()) & 0xFF:02X}\n".encode()


def body_of(reply: bytes) -> str:
    """Return what a line says.

    Raises:
        LinkError: its sum is wrong.
        DeviceError: the stage refuses.
    """
    body = reply.decode("latin-1").rpartition("*")[0]
    if framed(body) != reply:
        raise LinkError(f"{reply!r} has a wrong sum")
    if match := re.fullmatch(r"NO (\d)", body):
        raise DeviceError(errno.EINVAL, f"the stage refuses: {REFUSALS.get(int(match[1]), body)}")
    return body


def identity() -> Exchange:
    """Return the exchange that asks who it is."""
    return Exchange(framed("ID?"), line_of, body_of, TIMEOUT_S, True, "ask for the identity")


def state() -> Exchange:
    """Return the exchange that reads state, position, velocity and fault."""

    def decode(reply: bytes) -> State:
        match = STATE.fullmatch(body_of(reply))
        if match is None:
            raise LinkError(f"read the state: {reply!r} is not a state")
        return match[1], int(match[2]), int(match[3]), int(match[4])

    return Exchange(framed("ST?"), line_of, decode, TIMEOUT_S, True, "read the state")


def order(text: str) -> Exchange:
    """Return the exchange of an order; each has the same effect twice, so the kit may repeat it."""

    def decode(reply: bytes) -> None:
        if (body := body_of(reply)) != "OK":
            raise LinkError(f"send {text!r}: {body!r} does not answer it")

    return Exchange(framed(text), line_of, decode, TIMEOUT_S, True, f"send {text!r}")


# --- the driver -------------------------------------------------------------------------------------

MODES = drive_axes.BANK_MODES | drive_axes.POSITION_MODES | ControlMode.VELOCITY
AxisTable: Any = drive_axes.drive_table({})


class Settings(drive_axes.DriveSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of the device, beside those of DriveSettings.

    Attributes:
        axis: the one axis.
        steps_per_m: steps in a metre.
        watchdog_s: the stage halts after this time without a line [s].
    """

    axis: list[AxisTable]
    steps_per_m: float
    watchdog_s: float = 0.2


class Stage(drive_axes.AxesUnit):
    """The one unit on the line."""

    def __init__(self, name: str, settings: Settings, spec: BlockSpec, kit: Kit) -> None:
        super().__init__(name, _axes(settings), spec, kit)
        self._per_m = settings.steps_per_m
        self._watchdog_s = settings.watchdog_s
        self._hardest = _axes(settings)[0].acceleration_max

    def open(self) -> Steps:
        """Refuse another device, halt, set the dead-man; runs again after every loss."""
        who = yield identity()
        if not who.startswith("LINA-2,"):
            raise DeviceError(errno.ENODEV, f"identify {self.name}: {who!r} answers; want a LINA-2")
        yield from self.stop()
        yield order(f"WD {round(self._watchdog_s * 1000)}")

    def poll(self) -> Steps:
        """Read the state, and tell the bank."""
        letter, position, velocity, fault = yield state()
        self.report(
            np.array([position / self._per_m]),
            np.array([velocity / self._per_m]),
            moving=np.array([letter == "M"]),
            done=np.array([letter == "I"]),
            fault=[FAULTS.get(fault, f"fault {fault}")],
        )

    def start_position(self, axis: int, position: float, speed: float, action: DriveAction) -> Steps:
        """Move."""
        numbers = [self._steps_of(value) for value in (position, speed, action.acceleration_max)]
        yield order("MV {} {} {}".format(*numbers))

    def start_velocity(self, axis: int, velocity: float, action: DriveAction) -> Steps:
        """Run."""
        yield order(f"RV {self._steps_of(velocity)} {self._steps_of(action.acceleration_max)}")

    def halt(self, axis: int, *, fastest: bool) -> Steps:
        """Brake with the highest acceleration; there is nothing faster."""
        yield order(f"HA {self._steps_of(self._hardest)}")

    def reset(self, axis: int) -> Steps:
        """Clear the fault."""
        yield order("CE")

    def _steps_of(self, value: float) -> int:
        return round(value * self._per_m)


class StageDriver(LineDriver):
    """The driver: what it shows, and its one unit."""

    Settings = Settings
    # for `sioms driver check`: how to run it against its simulated device
    rig = {  # noqa: RUF012
        "tables": '[device.stage]\ndriver = "./linear_stage.py"\nline = { serial = "{port}", baud = 115200 '
        "}\nsteps_per_m = 1e6\n"
        '[[device.stage.axis]]\nname = "x"\nvelocity_max = 0.1\nacceleration_max = 1.0\n',
        "simulator": ["linear_stage_device.py"],
    }

    @classmethod
    def describe(cls, name: str, settings: Settings) -> Description:
        """Tell the axis; pure: it runs before there is a process."""
        if len(settings.axis) != 1:
            raise ValueError(f"axis: {len(settings.axis)} given; the stage has one")
        if settings.steps_per_m <= 0:
            raise ValueError(f"steps_per_m = {settings.steps_per_m:g}; want a positive number")
        if not 3 / settings.poll_hz <= settings.watchdog_s <= 10:
            raise ValueError(f"watchdog_s = {settings.watchdog_s:g}; want three polls, {3 / settings.poll_hz:g}, to 10")
        spec = drive_axes.axis_spec("", _axes(settings), "LINA-2", settings.capacity, settings.history)
        return Description((spec,), settings.poll_hz, lease_s=max(0.5, 5 / settings.poll_hz))

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return lines of the manual, and what they mean."""
        return (
            Golden("identity", identity(), b"ID?*CC\n".hex(), framed("LINA-2,1.04").hex(), "LINA-2,1.04"),
            Golden("state", state(), b"ST?*E6\n".hex(), framed("M 12345 -500 0").hex(), ("M", 12345, -500, 0)),
        )

    def __init__(self, name: str, settings: Settings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.line = settings.line
        self._units = (Stage(name, settings, self.describe(name, settings).blocks[0], kit),)

    @property
    def units(self) -> Sequence[LineUnit]:
        """The stage."""
        return self._units


def _axes(settings: Settings) -> list[Any]:
    return [drive_axes.axis_settings(axis, MODES) for axis in settings.axis]


DRIVER = StageDriver
