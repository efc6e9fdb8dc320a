"""Simulated axes: a motion bank that closes its loop over simulated motors and steppers.

Besides the axes it shows a block ``plant`` with what the simulated world feels of them: the true
position of each load and the force with which it presses on its wall. Simulated sensors read it.
Light beams that look at its own axes may be part of the device, as a binary port ``beams``: they see
the axes a tick earlier than those of another process.

    [device.mod0]
    driver = "sim-axes"
    [[device.mod0.axis]]
    name = "xaxis"
    velocity_max = 0.5
    acceleration_max = 5.0
    force_max = 40.0
    motor = { mass = 2.0, viscous = 4.0, coulomb = 3.0, stiction = 4.0, encoder_step = 1e-6 }
    [[device.mod0.beam]]
    name = "beam0"
    boxes = [{ xaxis = [0.10, 0.14] }]

A device with ``carries = "world.left_joints"``, a node of a ``sim-world``, carries a finger there: its first three
motors are the finger's joints x, y and th, and bear the springs of its mount. An axis with a ``load_node``, an analog
node of one channel, bears the force there [N or N m] beside that of its motor, for what answers slowly. Where such a
node tells nothing (its world is gone, stands still or is late), nothing is borne, brakes hold the axes, and what moves
is in fault until it is reset.

An axis with a ``model_file`` (as ``sioms reconcile`` writes it) is the twin of the axis that the model was found
for: mass, friction, encoder and all effects come from the file, stops and switches from ``motor``. The name and a
check sum of the model show in the plant's description, so that a reload takes up a changed file.
"""

from __future__ import annotations

import errno
import math
import time
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, TypeAlias

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from sioms.motion import SWITCH_HOME, SWITCH_MINUS, SWITCH_PLUS, AxisBank, AxisKind, AxisSettings
from sioms.plant.binary import Beam, Box, port_values
from sioms.plant.effects import Effect, build_effects, parse_effects
from sioms.plant.foreign import Laws, TwinAxes, twin
from sioms.plant.motor import MotorBank
from sioms.plant.parameters import Motor
from sioms.plant.stepper import Stepper, StepperBank
from sioms.protocol.flags import AxisStatus, ControlMode, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, AnyBlock, AxisBlock, BinaryBlock, BlockSpec, Description
from sioms.sdk.driver import Kit, QuietSteps, TickDriver
from sioms.sdk.exchange import LinkError
from sioms.sdk.pages import Pages
from sioms.sdk.tables import from_table, table_type

from .axes_step import EDGE
from .borne import JOINTS, Borne
from .quiet_axes import QuietAxes

# A profile takes some 20 us to plan; few at a time, so that a plan never delays a tick.
_PLANS, _SLACK_NS = 8, 300_000
_FAULT = int(AxisStatus.FAULT)

Array = NDArray[np.float64]

ALL_MODES = ControlMode(0x7FFF)
FORCE_MODES = (
    ControlMode.FORCE
    | ControlMode.FORCE_VELOCITY
    | ControlMode.SPECIFIED_FORCE_OFFSET
    | ControlMode.SPECIFIED_MAX_FORCE
)

AxisTable: Any = table_type(
    AxisSettings,
    without=("kind", "modes"),
    extra={
        "description": (str, ""),
        "bandwidth_hz": (float, 30.0),
        "count": (Annotated[int, Meta(ge=1, le=10_000)], 1),
        "motor": (table_type(Motor) | None, None),
        "stepper": (table_type(Stepper) | None, None),
        "model_file": (str, ""),
        "load_node": (str, ""),
    },
)
"""Keys of an axis: those of AxisSettings, ``motor`` or ``stepper``, the ``model_file`` of a twin, and a ``load_node``.

``bandwidth_hz`` sets the gains of a servo that gives none; ``count`` above 1 makes so many of it, with
the numbers from 0 behind their name.
"""


Built: TypeAlias = tuple[MotorBank | None, StepperBank | None, list[AxisSettings]]
"""The plants, and the settings of the bank."""


class BeamTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A light beam, the next bit of the port ``beams``: 1 while broken.

    Attributes:
        boxes: each a table of axis to [low, high]: broken while all axes of a box lie within.
        name: for the reader of the configuration.
    """

    boxes: list[dict[str, tuple[float, float]]]
    name: str = ""


class SimAxesSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device.

    Attributes:
        axis: the axes.
        beam: light beams that look at them.
        carries: node of a world with the joints of a finger; none when empty.
        world_age_max_s: an older reading of that node tells nothing; nor is a finger carried on after a later tick.
        tick_hz: rate of the control loop.
        capacity: commands that each axis buffers.
        effects: effects beyond the motors' parameters, a table per axis name or "*".
        effects_file: the same from a TOML file, to be hidden from who looks at the configuration.
        history: snapshots kept for readers.
        late_max_s: a tick later than this stops all motion with a fault; long, because nothing real waits for it.
    """

    axis: list[AxisTable]
    beam: list[BeamTable] = []
    carries: str = ""
    world_age_max_s: float = 0.05
    tick_hz: float = 1000.0
    capacity: int = 16384
    effects: dict[str, dict[str, Any]] = {}
    effects_file: str = ""
    history: int = 256
    late_max_s: float = 2.0


class SimAxes(TickDriver):
    """Servo and stepper axes over simulated mechanics.

    Concurrency: the one thread of the driver process.
    """

    Settings = SimAxesSettings
    realtime_priority = 0

    @classmethod
    def describe(cls, name: str, settings: SimAxesSettings) -> Description:
        """Tell the axes and the plant; reads the effects file, so that its mistakes show before the start."""
        if not settings.axis:
            raise ValueError("axis: none given; want a table [[...axis]] for each axis")
        motors, _, _ = built = _build(settings)
        SimAxes._checked = (settings, built)
        if settings.carries and (motors is None or motors.position.size < JOINTS):
            raise ValueError(f"carries: fewer than {JOINTS} motors; want those of a finger's joints x, y and th first")
        described = cls._describe(settings)
        if described.inputs and not 1.0 / settings.tick_hz < settings.world_age_max_s < math.inf:
            raise ValueError(
                f"world_age_max_s {settings.world_age_max_s:g}; want more than a tick, {1 / settings.tick_hz:g} s"
            )
        return described

    @staticmethod
    def _describe(settings: SimAxesSettings) -> Description:
        axes = _axes(settings)
        beams = len(_boxes(settings))
        blocks = [
            BlockSpec(
                "", NodeClass.AXIS, tuple(_axis_channel(axis) for axis in axes),
                history=settings.history, capacity=settings.capacity,
            ),
            BlockSpec("plant", NodeClass.ANALOG, tuple(_plant_channels(axes)), history=settings.history),
        ]  # fmt: skip
        if beams:
            port = ChannelInfo("in", minimum=0, maximum=2**beams - 1, width=beams)
            blocks.append(BlockSpec("beams", NodeClass.BINARY, (port,), history=4 * settings.history))
        inputs = tuple(dict.fromkeys(node for node in (settings.carries, *(axis.load_node for axis in axes)) if node))
        return Description(tuple(blocks), settings.tick_hz, inputs, lease_s=1.0)

    _checked: ClassVar[tuple[SimAxesSettings, Built] | None] = None
    """What ``describe`` has built to check it; a device that is made of the same settings next takes it."""
    make_up_ns: ClassVar[int] = 20_000_000
    """How long a tick may make up for turns [ns]: a machine that is too slow for them shows its axes in slow motion."""

    def __init__(self, name: str, settings: SimAxesSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        axes, plant, *port = self._describe(settings).blocks
        checked, SimAxes._checked = SimAxes._checked, None
        built = checked[1] if checked is not None and checked[0] is settings else _build(settings)
        self._servos, self._steppers, configured = built
        self._tick_ns = round(1e9 / settings.tick_hz)
        self.bank = AxisBank(
            configured,
            tick_s=1 / settings.tick_hz,
            markers=kit.markers,
            capacity=settings.capacity,
            late_max_s=_late_max_s(settings),
            makes_up=lambda: self._command is not None and not self._is_still,
        )
        self._axes, self._plant = AxisBlock(axes, self.bank), AnalogBlock(plant)
        self._port = BinaryBlock(port[0]) if port else None
        self._beams = [Beam(boxes) for boxes in _boxes(settings)]
        n = len(configured)
        stepper = np.array([axis.kind is AxisKind.STEPPER for axis in configured])
        self._servo_rows, self._stepper_rows = np.flatnonzero(~stepper), np.flatnonzero(stepper)
        servos = [axis for axis in _axes(settings) if axis.motor is not None]
        borne = None
        if self._servos is not None:
            own = (self._servos, servos, settings.carries, settings.world_age_max_s, 1 / settings.tick_hz)
            borne = Borne(*own, lambda node: self.kit.inputs[node])
        self._borne = borne if borne is not None and borne.any else None
        self._reading = np.zeros(n)
        self._switches = np.zeros(n, dtype=np.int64)
        self._command: Array | None = None
        self._last_ns = 0
        self._late_ns = int(_late_max_s(settings) * 1e9)
        self._stride = min(_stride(axis, 1 / settings.tick_hz) for axis in settings.axis)
        self._ahead = 0
        self._is_still = False
        self._has_effects = bool(settings.effects or settings.effects_file or any(a.model_file for a in settings.axis))
        self._all = np.arange(n)
        self._seen = np.full(n, np.nan)
        # A stepper's command, and one with an integral in it, goes on if it does so at all; others only come to rest.
        self._near = np.array([0.0 if s.kind is AxisKind.STEPPER or s.ki else 1e-9 * s.force_max for s in configured])
        self._found = 0
        """What the steps have found in a tick that they have begun."""

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The axes, the plant and, if there are any, the beams."""
        return (self._axes, self._plant) if self._port is None else (self._axes, self._plant, self._port)

    def quiet_steps(self, pages: Pages, instants: NDArray[np.int64]) -> QuietSteps | None:
        """Return the steps of motors and steppers, unless something else goes on between commands and positions."""
        motors = self._servos
        if self._borne is not None or (motors is not None and motors.has_drive_effects):
            return None
        return QuietAxes(self, pages, instants)

    def tick(self, now_ns: int) -> None:
        """Let the world go on under the last command up to now, measure, and command anew.

        The controller of a device does not miss its turns because this machine was busy: after a late tick they are
        made up for, a few at once, and shown each at its own time; what that cannot be done for soon is left to the
        next tick, so that others are served meanwhile. Later than ``late_max_s`` the bank stops all motion.
        """
        if self._found and self._finish_turn(now_ns):
            return
        if self._borne is not None:
            self._bear(self._borne, now_ns)
        if self._is_still:  # the turns that were left out change nothing; the world keeps to its grid of ticks
            self._last_ns += max(0, (now_ns - self._last_ns) // self._tick_ns - 1) * self._tick_ns
            self._is_still = False
        behind = round((now_ns - self._last_ns) / self._tick_ns) if self._command is not None else 0
        if behind > self._stride and self.is_at_rest():  # nor do those that were missed
            self._last_ns, behind, self._is_still = self._last_ns + (behind - 1) * self._tick_ns, 1, False
        if now_ns - self._last_ns <= self._late_ns and behind > self._stride:
            behind = self._make_up(behind)
        late = behind > self._stride and now_ns - self._last_ns <= self._late_ns
        if not late:
            self._turn(now_ns, behind)
        for block in self.blocks:
            block.stamp_ns = self._last_ns if late else 0

    def _finish_turn(self, now_ns: int) -> bool:
        """Finish a turn that steps have begun; return whether it was that of the tick, else it is shown as it is."""
        found, self._found = self._found, 0
        self._command = self.bank.finish_tick(found & ~EDGE)
        self._show()
        if self._port is not None:
            self._look(self._port, self._last_ns)
        is_last = round((now_ns - self._last_ns) / self._tick_ns) < 1
        for block in self.blocks:
            block.stamp_ns = 0
            if not is_last:
                self.kit.publish(block, self._last_ns)
        return is_last

    def _make_up(self, behind: int) -> int:
        """Make up for turns, for as long as that may take, and show them; return how many are left."""
        until_ns = time.monotonic_ns() + self.make_up_ns
        while behind > self._stride:
            at_ns = self._last_ns + self._stride * self._tick_ns
            self._turn(at_ns, self._stride)
            behind -= self._stride
            if behind > self._stride and time.monotonic_ns() >= until_ns:
                break  # this one is shown as that of the tick
            for block in self.blocks:  # what looks at these axes sees them go there
                self.kit.publish(block, at_ns)
        return behind

    def open(self) -> None:
        """Wait for the loads.

        Raises:
            LinkError: one of them is not there.
        """
        missing = self._borne.missing(time.monotonic_ns()) if self._borne is not None else ""
        if missing:
            raise LinkError(f"{missing}: no load is known; want the simulated world there")

    def _bear(self, borne: Borne, now_ns: int) -> None:
        """Take the loads; where they are not known any more, or not while axes are to move, all are in fault."""
        was_known = borne.is_known
        why = borne.take(now_ns)
        if why and (was_known or not self.bank.is_idle(self._all)):
            fresh = np.flatnonzero((self.bank.arrays["latched"] & _FAULT) == 0)
            if fresh.size:
                self.bank.fault(fresh, why, now_ns)

    def _turn(self, now_ns: int, ticks: int) -> None:
        beside_ns = 0
        if self._command is not None:
            for _ in range(self._ahead, min(ticks, self._stride)):  # what is later than may be made up for stands still
                self._advance(self._command)
            self._ahead = max(0, self._ahead - ticks)
            beside_ns = now_ns - self._last_ns - ticks * self._tick_ns
        if 20 * abs(beside_ns) < self._tick_ns or abs(beside_ns) > self._tick_ns:
            beside_ns = 0
        self._last_ns = now_ns - beside_ns  # where the world is: it goes by whole ticks, also when one came early
        self._measure()
        if beside_ns:
            self._shift(beside_ns * 1e-9)
        self.inputs_ns = time.monotonic_ns()
        self._command = self.bank.tick(now_ns, self._reading, self._switches)
        self._show()
        if self._port is not None and not beside_ns:
            self._look(self._port, now_ns)

    def is_at_rest(self) -> bool:
        """Whether world and command are at a fixed point; turns that are left out then need not be made up for."""
        if self._command is None or self._has_effects or self._borne is not None:
            return False
        with np.errstate(invalid="ignore"):
            still = bool((np.abs(self._command - self._seen) <= self._near).all())
        self._seen[:] = self._command
        worlds = [world for world in (self._servos, self._steppers) if world is not None]
        still = still and not any(np.count_nonzero(world.velocity) for world in worlds)
        self._is_still = still and self.bank.is_idle(self._all)
        return self._is_still

    def slack(self, now_ns: int, until_ns: int) -> None:
        """Let the world go on to the next tick, which is sooner done then, and plan profiles ahead while there is
        time.
        """
        if self._command is not None and not self._ahead:
            self._advance(self._command)
            self._ahead = 1
        if until_ns - time.monotonic_ns() > _SLACK_NS:
            self.bank.plan_ahead(_PLANS)

    def plan_early(self) -> bool:
        """Plan profiles ahead long before the next tick; return whether there were any."""
        until_ns = self._last_ns + self._tick_ns
        return until_ns - time.monotonic_ns() > 2 * _SLACK_NS and self.bank.plan_ahead(_PLANS) > 0

    def _advance(self, command: Array) -> None:
        motors = self._servos
        if motors is not None:
            forces = command[self._servo_rows]
            if self._borne is not None:
                self._borne.press(forces, self.bank.arrays["limp"][self._servo_rows])
            motors.advance(forces)
        if self._steppers is not None:
            self._steppers.advance(command[self._stepper_rows])

    def _measure(self) -> None:
        if self._servos is not None:
            self._reading[self._servo_rows] = self._servos.encoder.position
            self._switches[self._servo_rows] = _switch_bits(self._servos)
        if self._steppers is not None:
            self._reading[self._stepper_rows] = self._steppers.reading
            self._switches[self._stepper_rows] = _switch_bits(self._steppers)

    def _shift(self, by_s: float) -> None:
        """Let a tick that came early read what would be read by then."""
        if self._servos is not None:
            self._reading[self._servo_rows] += self._servos.velocity * by_s
        if self._steppers is not None:
            self._reading[self._stepper_rows] += self._steppers.velocity * by_s

    def _show(self) -> None:
        data = self._plant.data.reshape(-1, 2)
        if self._servos is not None:
            data[self._servo_rows, 0] = self._servos.load_position
            data[self._servo_rows, 1] = self._servos.contact_force
        if self._steppers is not None:
            data[self._stepper_rows, 0] = self._steppers.position

    def _look(self, port: BinaryBlock, now_ns: int) -> None:
        """Set the beams; of several edges in a tick all but the last are published at once."""
        positions = self._plant.data[::2].tolist()
        edges = [(e, bit) for bit, beam in enumerate(self._beams) for e in beam.sample(positions, now_ns)]
        for index, (stamp_ns, value) in enumerate(port_values(int(port.data[0]), edges)):
            if index:
                self.kit.publish(port, now_ns)
            port.set(0, value, stamp_ns)


def _late_max_s(settings: SimAxesSettings) -> float:
    """Return how late a tick may be [s]; who carries a finger goes on no longer than its world is waited for."""
    return min(settings.late_max_s, settings.world_age_max_s) if settings.carries else settings.late_max_s


def _switch_bits(bank: MotorBank | StepperBank) -> NDArray[np.int64]:
    bits: NDArray[np.int64] = bank.at_limit_minus * SWITCH_MINUS
    bits += bank.at_limit_plus * SWITCH_PLUS
    bits += bank.at_home * SWITCH_HOME
    return bits


def _axes(settings: SimAxesSettings) -> list[Any]:
    """Return the axes one by one, those with a count as so many."""
    axes: list[Any] = []
    for axis in settings.axis:
        if axis.count == 1:
            axes.append(axis)
        else:
            axes += [msgspec.structs.replace(axis, name=f"{axis.name}{i}", count=1) for i in range(axis.count)]
    return axes


def _build(settings: SimAxesSettings) -> Built:
    """Make the plants and the settings of the bank.

    Raises:
        ValueError: an axis, a motor or an effect that cannot be.
    """
    tick_s, axes = 1 / settings.tick_hz, _axes(settings)
    servos = [axis for axis in axes if axis.motor is not None]
    steppers = [axis for axis in axes if axis.stepper is not None]
    for axis in axes:
        if (axis.motor is None) == (axis.stepper is None):
            raise ValueError(f"axis {axis.name}: has neither or both of motor and stepper; want one of them")
        if axis.load_node and axis.motor is None:
            raise ValueError(
                f"axis {axis.name}: a stepper with a load_node; want a motor, steppers bear no load from nodes"
            )
    names = [axis.name for axis in servos]
    plants, effects, laws = _twins(servos, [from_table(Motor, a.motor) for a in servos], tick_s)
    effects += _effects(settings, names)
    motors = MotorBank(plants, tick_s, effects, laws=laws) if servos else None
    rotors = StepperBank([from_table(Stepper, a.stepper) for a in steppers], tick_s) if steppers else None
    return motors, rotors, [_axis_settings(axis, tick_s) for axis in axes]


def _boxes(settings: SimAxesSettings) -> list[list[Box]]:
    """Return the boxes of each beam.

    Raises:
        ValueError: an axis that is not there, or an interval upside down.
    """
    names = [axis.name for axis in _axes(settings)]
    for number, beam in enumerate(settings.beam):
        for axis, (low, high) in (item for box in beam.boxes for item in box.items()):
            if axis not in names:
                raise ValueError(f"beam {number}: no axis {axis}; want one of {', '.join(names)}")
            if not low <= high:
                raise ValueError(f"beam {number}: interval {low:g} to {high:g} of {axis}; want low first")
    return [
        [Box(tuple((names.index(axis), low, high) for axis, (low, high) in box.items())) for box in beam.boxes]
        for beam in settings.beam
    ]


def _effects(settings: SimAxesSettings, servos: Sequence[str]) -> tuple[Effect, ...]:
    """Return the effects of the table and of the file."""
    effects = build_effects(settings.effects, servos, "effects")
    if not settings.effects_file:
        return effects
    return effects + parse_effects(_text("effects_file", settings.effects_file), servos, settings.effects_file)


def _text(key: str, path: str) -> str:
    """Return the content of a file that the configuration names."""
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except OSError as error:
        reason = error.strerror or errno.errorcode.get(error.errno or 0, "?")
        raise ValueError(f"{key} {path}: {reason}; want a TOML file") from error


def _twins(
    servos: Sequence[Any], motors: Sequence[Motor], tick_s: float
) -> tuple[Sequence[Motor], tuple[Effect, ...], Laws]:
    """Let the axes with a model file be what it says."""
    files = {i: axis.model_file for i, axis in enumerate(servos) if axis.model_file}
    if not files:
        return motors, (), Laws()
    twins: TwinAxes = twin("axes")
    texts = {i: (path, _text("model_file", path)) for i, path in files.items()}
    return twins(texts, motors, [(axis.name, axis.unit) for axis in servos], tick_s)


def _model_sum(axis: Any) -> str:
    """Say which model an axis is the twin of."""
    if not axis.model_file:
        return ""
    return f", model {zlib.crc32(_text('model_file', axis.model_file).encode()):08x}"


def _axis_settings(axis: Any, tick_s: float) -> AxisSettings:
    """Return the bank's settings; a servo without gains gets those of its bandwidth."""
    if axis.stepper is not None:
        return from_table(AxisSettings, axis, {"kind": AxisKind.STEPPER, "modes": ALL_MODES & ~FORCE_MODES})
    settings = from_table(AxisSettings, axis, {"kind": AxisKind.SERVO, "modes": ALL_MODES})
    if settings.k is not None:
        return settings
    k, kz = _gains(axis, tick_s)
    return replace(settings, k=k, kz=kz)


def _gains(axis: Any, tick_s: float) -> tuple[float, float]:
    """Return k and kz of a critically damped lead: k (1 + kz) = m w^2, -k kz T = 2 m w."""
    rate = 2 * np.pi * axis.bandwidth_hz
    if not 0 < rate * tick_s <= 0.4:
        raise ValueError(
            f"axis {axis.name}: bandwidth_hz {axis.bandwidth_hz:g} at a tick of {1 / tick_s:g} Hz; "
            f"want above 0 and at most {0.4 / (2 * np.pi * tick_s):.3g}"
        )
    lead = 2 * axis.motor.mass * rate / tick_s
    k = axis.motor.mass * rate * rate + lead
    return k, -lead / k


def _stride(axis: Any, tick_s: float) -> int:
    """Return how many ticks a turn of the controller may make up for after a late tick and its loop be stable.

    The gains are for one tick: over s ticks the velocity's, 2 w, is s times as high and acts s times as long; stable
    below 2.
    """
    if axis.stepper is not None:
        return 4
    return 1 if axis.k is not None else max(1, int((0.8 / (2 * np.pi * axis.bandwidth_hz * tick_s)) ** 0.5))


def _axis_channel(axis: Any) -> ChannelInfo:
    limits = {"velocity": axis.velocity_max, "acceleration": axis.acceleration_max}
    if axis.jerk_max is not None:
        limits["jerk"] = axis.jerk_max
    modes = ALL_MODES & ~FORCE_MODES
    if axis.stepper is None:
        limits["force"] = axis.force_max
        modes = ALL_MODES
    return ChannelInfo(
        axis.name, axis.unit, axis.position_min, axis.position_max, 0, int(modes), limits, axis.description
    )  # fmt: skip


def _plant_channels(axes: Sequence[Any]) -> list[ChannelInfo]:
    force_unit = {"m": "N", "rad": "N*m"}
    return [
        channel
        for axis in axes
        for channel in (
            ChannelInfo(
                f"{axis.name}_position",
                axis.unit,
                description=f"true position of the load{_model_sum(axis)}",
            ),
            ChannelInfo(f"{axis.name}_contact", force_unit.get(axis.unit, "N"), description="force on the wall"),
        )
    ]


DRIVER = SimAxes
