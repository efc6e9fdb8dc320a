"""The tables of simulated axes, and what is made of them: plants, settings of the bank, blocks.

No step of a tick is here.
"""

from __future__ import annotations

import errno
import re
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, TypeAlias

import msgspec
import numpy as np
from msgspec import Meta

from sioms.motion import AxisKind, AxisSettings
from sioms.motion.settings import EVERY_MODE
from sioms.plant.binary import Box
from sioms.plant.effects import Effect, build_effects, parse_effects
from sioms.plant.foreign import Laws, TwinAxes, twin
from sioms.plant.motor import MotorBank
from sioms.plant.parameters import Motor
from sioms.plant.stepper import Stepper, StepperBank
from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import BlockSpec, Description
from sioms.sdk.tables import from_table, table_type

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


def describe(settings: SimAxesSettings) -> Description:
    """Tell the blocks and inputs that a device of these settings has."""
    axes = axes_of(settings)
    beams = len(boxes(settings))
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


def late_max_s(settings: SimAxesSettings) -> float:
    """Return how late a tick may be [s]; who carries a finger goes on no longer than its world is waited for."""
    return min(settings.late_max_s, settings.world_age_max_s) if settings.carries else settings.late_max_s


def axes_of(settings: SimAxesSettings) -> list[Any]:
    """Return the axes one by one, those with a count as so many."""
    axes: list[Any] = []
    for axis in settings.axis:
        if axis.count == 1:
            axes.append(axis)
        else:
            axes += [msgspec.structs.replace(axis, name=f"{axis.name}{i}", count=1) for i in range(axis.count)]
    return axes


def build(settings: SimAxesSettings) -> Built:
    """Make the plants and the settings of the bank.

    Raises:
        ValueError: an axis, a motor or an effect that cannot be.
    """
    tick_s, axes = 1 / settings.tick_hz, axes_of(settings)
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
    try:
        motors = MotorBank(plants, tick_s, effects, laws=laws) if servos else None
    except ValueError as error:
        named = re.sub(r"^build motor (\d+)", lambda found: f"axis {servos[int(found[1])].name}: motor", str(error))
        raise ValueError(named) from None
    rotors = StepperBank([from_table(Stepper, a.stepper) for a in steppers], tick_s) if steppers else None
    return motors, rotors, [_axis_settings(axis, tick_s) for axis in axes]


def boxes(settings: SimAxesSettings) -> list[list[Box]]:
    """Return the boxes of each beam.

    Raises:
        ValueError: an axis that is not there, or an interval upside down.
    """
    names = [axis.name for axis in axes_of(settings)]
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
        return from_table(AxisSettings, axis, {"kind": AxisKind.STEPPER, "modes": EVERY_MODE & ~FORCE_MODES})
    settings = from_table(AxisSettings, axis, {"kind": AxisKind.SERVO, "modes": EVERY_MODE})
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


def stride(axis: Any, tick_s: float) -> int:
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
    modes = EVERY_MODE & ~FORCE_MODES
    if axis.stepper is None:
        limits["force"] = axis.force_max
        modes = EVERY_MODE
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
