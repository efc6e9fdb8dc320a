"""A simulated plane: an object on the platen between rubber fingers that simulated axes carry.

It reads where the axes are from their ``plant`` nodes, integrates finer than its tick, and shows for each finger what
other simulated devices feel: force sensors ``fx`` and ``fy``, tactile fingers ``normal``, ``angle`` and ``curvature``.
A second node of each finger, its name with ``_joints``, is what axes carry (``carries``): where each joint is behind
its spring. Where the object truly is shows the node ``pose``, for pictures and tests.

    [device.world]
    driver = "sim-world"
    object = { shape = "disk", radius_m = 0.02, pose = [0.17, 0.16, 0.0] }
    [[device.world.finger]]
    name = "left"
    axes = ["mod0.plant.xaxis_position", "mod0.plant.zaxis_position", ""]  # x, y and angle; "" stays 0
    mount = { stiffness = 1e5, turn_stiffness = 5.0, mass = 0.3, inertia = 2e-4 }

The stiffness of a mount lies between the axis and its finger, behind the axis's encoder; that of the servo comes in
series. While an axis is not there the world stands still and its readings are invalid. A world that is killed takes
what leans on it along: axes that carry a finger or have a ``load_node`` of it are in fault, fingers and force sensors
read invalid. World and axes see each other late; a mount whose damping is too low for that is refused.

No finger is ever put into the object. Where one stands in its place at the start, or comes back with its axis inside
it, the platen is empty, which the log says: fingers meet nothing, and ``pose`` is flagged invalid. The object is laid
where the configuration puts it as soon as no finger is there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import msgspec

from sioms.plant import outline as outlines
from sioms.plant.carried import most_late
from sioms.plant.outline import Outline
from sioms.plant.planar import RUBBER_PA, Body, Finger, Mount, World
from sioms.plant.skin import skin
from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, AnyBlock, BlockSpec, Description
from sioms.sdk.driver import Kit, TickDriver
from sioms.sdk.tables import from_table, table_type

MountTable: Any = table_type(Mount)

_CATCH_UP = 50
"""Ticks that the world goes on for at once; for what is later it stands still."""
_INVALID = int(AnalogStatus.INVALID)
_INTO_M = 5e-4
"""How much deeper a finger whose axis was away may be in the object: brakes let a motor go on by less."""

_POSE = (("x", "m"), ("y", "m"), ("angle", "rad"), ("vx", "m/s"), ("vy", "m/s"), ("spin", "rad/s"))
_FINGER = (
    ("normal", "N", "force along the contact's normal"),
    ("tangential", "N", "force on the object, anti-clockwise across the normal"),
    ("angle", "rad", "place of contact in the finger's own angle"),
    ("curvature", "1/m", "of the object, as the contact feels it"),
    ("clearance", "m", "from the object; negative in contact"),
    ("slides", "", "1 while the contact slides"),
    ("fx", "N", "force of the object on the finger"),
    ("fy", "N", "force of the object on the finger"),
    ("x_load", "N", "force of the finger on the axis x"),
    ("y_load", "N", "force of the finger on the axis y"),
    ("th_load", "N*m", "torque of the link on the axis th"),
)
_JOINTS = tuple(
    (f"{joint}_{what}", "", f"{what} of the joint {joint} behind its spring, or of that spring")
    for what in ("place", "speed", "stiffness", "damping")
    for joint in ("x", "y", "th")
)
_STEADY = 2.5
"""An object of this many times step_s^2 and the stiffness of all rubber gains at most 3 % of its energy when thrown at
2 m/s between two fingers; one of two fifths of it 40 %."""
_MOST_STEPS = 1000
_FAR_M, _TURNED_RAD = 10.0, 100.0
_KEYS = {
    "disk": ("radius_m",), "rectangle": ("size_m", "corner_m"), "ellipse": ("size_m",),
    "polygon": ("points_m", "corner_m"), "spline": ("points_m",),
}  # fmt: skip
"""What describes the outline of each shape; no other shape reads it."""
_LATE_TICKS = 3
"""How late an axis is seen that ticks no less often, and is held: one tick here, one there, and between them."""


class ObjectTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The object.

    Attributes:
        shape: disk (radius_m), rectangle (size_m, corner_m), ellipse (size_m), polygon (points_m, corner_m) or spline
            (points_m).
        radius_m: of a disk.
        size_m: full sizes along its own x and y.
        points_m: corners, or points of the curve, anti-clockwise.
        corner_m: radius of the corners, 0 for sharp ones.
        pose: x [m], y [m] of the centroid and angle [rad] at the start.
        mass: [kg].
        platen_friction: coefficient on the platen.
    """

    shape: Literal["disk", "rectangle", "ellipse", "polygon", "spline"]
    radius_m: float = 0.0
    size_m: tuple[float, float] = (0.0, 0.0)
    points_m: tuple[tuple[float, float], ...] = ()
    corner_m: float = 0.0
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mass: float = 0.1
    platen_friction: float = 0.2


class FingerTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A finger.

    Attributes:
        name: of its node.
        axes: nodes of one channel each with the positions of x [m], y [m] and th [rad]; '' for one that stays 0.
        mount: what lies between the axes and the rubber.
    """

    name: str
    axes: tuple[str, str, str]
    mount: MountTable = MountTable()


class SimWorldSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device.

    Attributes:
        object: what lies on the platen.
        finger: the fingers.
        tick_hz: rate of what is shown.
        step_s: the world goes on in steps of at most so much [s].
        history: snapshots kept for readers.
    """

    object: ObjectTable
    finger: list[FingerTable]
    tick_hz: float = 1000.0
    step_s: float = 0.25e-3
    history: int = 64


class SimWorld(TickDriver):
    """A simulated plane.

    Concurrency: the one thread of the driver process.
    """

    Settings = SimWorldSettings
    realtime_priority = 0

    @classmethod
    def describe(cls, name: str, settings: SimWorldSettings) -> Description:
        """Tell the object's pose and what each finger feels."""
        least_s = 1.0 / (settings.tick_hz * _MOST_STEPS)
        if not least_s <= settings.step_s < math.inf:
            raise ValueError(
                f"step_s {settings.step_s:g}; want at least {least_s:.2g} s, {_MOST_STEPS} steps a tick, finite"
            )
        _body(settings.object)
        names = [finger.name for finger in settings.finger]
        for index, finger in enumerate(settings.finger):
            if finger.name in (*names[:index], "pose", *(f"{name}_joints" for name in names)):
                raise ValueError(f"finger {index}: name {finger.name!r} is taken; want another")
            _check(finger, _LATE_TICKS / settings.tick_hz)
        _follows(settings)
        pose = tuple(ChannelInfo(channel, unit, description="true, of the object") for channel, unit in _POSE)
        felt = tuple(ChannelInfo(channel, unit, description=what) for channel, unit, what in _FINGER)
        blocks = [BlockSpec("pose", NodeClass.ANALOG, pose, history=settings.history)]
        joints = tuple(ChannelInfo(channel, unit, description=what) for channel, unit, what in _JOINTS)
        blocks += [BlockSpec(one, NodeClass.ANALOG, felt, history=settings.history) for one in names]
        blocks += [BlockSpec(f"{one}_joints", NodeClass.ANALOG, joints, history=settings.history) for one in names]
        inputs = tuple(dict.fromkeys(node for finger in settings.finger for node in finger.axes if node))
        return Description(tuple(blocks), settings.tick_hz, inputs, lease_s=1.0)

    def __init__(self, name: str, settings: SimWorldSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self._blocks = [AnalogBlock(spec) for spec in self.describe(name, settings).blocks]
        self._body = _body(settings.object)
        skin()  # the tables, before the first tick
        self._world: World | None = None
        self._missing = True
        self._last_ns = 0

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The pose, then one block for what each finger feels, then one for its joints."""
        return self._blocks

    def tick(self, now_ns: int) -> None:
        """Follow the axes up to now; while one is not there, stand still."""
        places = [[self._position(node, now_ns) for node in finger.axes] for finger in self.settings.finger]
        known = [[at for at in place if at is not None] for place in places]
        missing = any(len(place) < 3 for place in known)
        elapsed_s, self._last_ns = (now_ns - self._last_ns) * 1e-9, now_ns
        if not missing:
            if self._world is None:
                mounts = [from_table(Mount, finger.mount) for finger in self.settings.finger]
                self._world = World(self._body, mounts, known, self.settings.object.pose)
                self._keep_apart(self._world, [0.0] * len(known))
            elif self._missing:  # an axis that is back may be elsewhere
                before = self._world.clearances()
                self._world.shift(known)
                self._keep_apart(self._world, [min(gap, 0.0) - _INTO_M for gap in before])
            elif elapsed_s > 0.0:
                elapsed_s = min(elapsed_s, _CATCH_UP / self.settings.tick_hz)
                self._world.command(known, elapsed_s)
                self._world.advance(elapsed_s, math.ceil(elapsed_s / self.settings.step_s))
            if self._world.lifted and min(self._world.clearances(self.settings.object.pose), default=0.0) >= 0.0:
                self._world.lay(self.settings.object.pose)
                self.kit.log("info", "no finger is where the object is configured to lie: it lies there now")
        self._missing = missing
        self._show(_INVALID if missing else 0)

    def _keep_apart(self, world: World, least_m: Sequence[float]) -> None:
        """Take the object off the platen where a finger is nearer to it than that; say which."""
        inside = [
            finger.name
            for finger, gap, least in zip(self.settings.finger, world.clearances(), least_m, strict=True)
            if gap < least
        ]
        if inside and not world.lifted:
            world.lift()
            self.kit.log(
                "warning",
                f"{', '.join(inside)} would be put into the object: the platen is empty until no finger is where the "
                "object is configured to lie; want the fingers moved away from there",
            )

    def _position(self, node: str, now_ns: int) -> float | None:
        if not node:
            return 0.0
        reading = self.kit.inputs[node].read(now_ns)
        return None if reading is None else float(reading["value"][0])

    def _show(self, flags: int) -> None:
        for block in self._blocks:
            block.flags[:] = flags
        world = self._world
        if world is None:
            return
        if world.lifted:
            self._blocks[0].flags[:] = _INVALID
        self._blocks[0].data[:] = (*world.pose, *world.speed)
        count = len(world.fingers)
        for finger, felt, joints in zip(
            world.fingers, self._blocks[1 : count + 1], self._blocks[count + 1 :], strict=True
        ):
            felt.data[:] = _felt(finger)
            stiffness, damping, _ = zip(*finger.mount.springs, strict=True)
            joints.data[:] = (*finger.place, *finger.speed, *stiffness, *damping)


def _felt(finger: Finger) -> tuple[float, ...]:
    """Return a finger's channels."""
    angle = finger.phi + finger.place[2]
    c, s = math.cos(angle), math.sin(angle)
    fx, fy = finger.tangential * s - finger.normal * c, -finger.normal * s - finger.tangential * c
    return (
        finger.normal, finger.tangential, finger.phi, 1.0 / finger.radius_m, finger.gap_m, float(finger.slides),
        fx, fy, *finger.joint_force,
    )  # fmt: skip


def _check(finger: FingerTable, late_s: float) -> None:
    """Refuse a mount that could not be joined to its axes.

    Raises:
        ValueError: a number out of its range, or a spring that would swing by the lateness of its ends.
    """
    mount = from_table(Mount, finger.mount)
    for joint, node, (stiffness, damping, mass) in zip(("x", "y", "th"), finger.axes, mount.springs, strict=True):
        if node and not late_s < most_late(stiffness, damping):
            least = (0.5 * stiffness * late_s) ** 2 / (stiffness * mass)
            raise ValueError(
                f"finger {finger.name}: joint {joint} is a spring of {stiffness:g} with a damping of {damping:g}; it "
                f"swings where its ends see each other {1e3 * late_s:g} ms late; want a damping_ratio above "
                f"{0.5 * math.sqrt(least):.2g}, a lower stiffness, more mass, or a higher tick_hz"
            )


def _follows(settings: SimWorldSettings) -> None:
    """Refuse what is too light for the steps.

    Raises:
        ValueError: a mass or an inertia, and what would be right.
    """
    step_s, rubber = min(settings.step_s, 1.0 / settings.tick_hz), 0.0
    for finger in settings.finger:
        mount = from_table(Mount, finger.mount)
        rubber += RUBBER_PA * mount.length_m
        for what, given, least in zip(
            ("mass", "inertia"), (mount.mass, mount.inertia), mount.least_mass(step_s), strict=True
        ):
            if given < least:
                raise ValueError(
                    f"finger {finger.name}: {what} {given:g} is thrown about by its springs in steps of "
                    f"{1e3 * step_s:g} ms; want at least {least:.2g}, softer springs, or a shorter step_s"
                )
    least = _STEADY * step_s**2 * rubber
    if settings.object.mass < least:
        raise ValueError(
            f"object: mass {settings.object.mass:g} kg is thrown about by the rubber in steps of {1e3 * step_s:g} ms; "
            f"want at least {least:.2g} kg, or a shorter step_s"
        )


def _body(table: ObjectTable) -> Body:
    """Make the object.

    Raises:
        ValueError: an outline that is not convex, or a number out of its range.
    """
    x, y, angle = table.pose
    if not (max(abs(x), abs(y)) <= _FAR_M and abs(angle) <= _TURNED_RAD):
        raise ValueError(
            f"describe object: its pose is {list(table.pose)}; want x and y within {_FAR_M:g} m of 0, on a platen, and "
            f"an angle within {_TURNED_RAD:g} rad"
        )
    usual = ObjectTable(table.shape)
    for key in sorted({key for keys in _KEYS.values() for key in keys} - set(_KEYS[table.shape])):
        if getattr(table, key) != getattr(usual, key):
            raise ValueError(
                f"describe object: {key} is given, which nobody reads of shape {table.shape}; want "
                f"{' and '.join(_KEYS[table.shape])}"
            )
    return Body(_outline(table), table.mass, table.platen_friction)


def _outline(table: ObjectTable) -> Outline:
    match table.shape:
        case "disk":
            return outlines.disk(table.radius_m)
        case "rectangle":
            return outlines.rectangle(*table.size_m, table.corner_m)
        case "ellipse":
            return outlines.ellipse(0.5 * table.size_m[0], 0.5 * table.size_m[1])
        case "polygon":
            return outlines.polygon(table.points_m, table.corner_m)
        case "spline":
            return outlines.spline(table.points_m)


DRIVER = SimWorld
