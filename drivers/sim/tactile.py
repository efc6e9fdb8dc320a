"""A simulated tactile finger: the strain pattern under an object that a simulated axis presses on it.

The driver knows the contact force and, where told, the contact angle from nodes of other devices.

    [device.tactile0]
    driver = "sim-tactile"
    force_node = "mod0.plant.zaxis_contact"
    angle_node = "mod0.plant.xaxis_position"
    angle_per_position = 78.7
    angle_rad = 1.29
    indenter_radius_m = 0.006

With a table ``shape``, see ``tactile_nodes``, it shows strains and shape as a real finger does. With a ``model_file``
(as ``sioms reconcile tactile`` writes it) it is the twin of the finger that the model was found for: elements, body and
all effects come from the file, the length of contact from ``finger``. A check sum of the model shows in the channels'
description, so that a reload takes up a changed file.
"""

from __future__ import annotations

import math
import zlib
from pathlib import Path
from typing import Any

import msgspec

from sioms.documents import read_bytes, toml_of
from sioms.drivers import tactile_nodes
from sioms.plant.finger import FingerShape, TactileArray
from sioms.plant.foreign import TwinFinger, twin
from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import BlockSpec, Description
from sioms.sdk.driver import Kit, TickDriver
from sioms.sdk.tables import from_table, table_type

FingerTable: Any = table_type(FingerShape)


class SimTactileSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device.

    Attributes:
        force_node: analog node of one channel with the force on the finger [N]; no contact when absent.
        angle_node: node of one channel that moves the contact along the finger; fixed when absent.
        angle_rad: contact angle, at position 0 of the angle node.
        angle_per_position: [rad/m or rad/rad].
        indenter_radius_m: radius of the object, infinite for a flat, 0 for an edge.
        curvature_node: node of one channel with the object's curvature [1/m], instead of a fixed radius.
        finger: geometry, material and faults.
        model_file: finger and effects from a model instead; only the length of contact is still ``finger``'s.
        gain, offset: of the elements [1, %]; one number for each.
        noise, resolution: of all [%].
        seed: of the noise.
        tick_hz: rate.
        history: snapshots kept for readers.
        shape: shows strains and the shape that touches, too.
    """

    force_node: str = ""
    angle_node: str = ""
    curvature_node: str = ""
    angle_rad: float = 1.29
    angle_per_position: float = 0.0
    indenter_radius_m: float = 6e-3
    finger: FingerTable = FingerTable()
    model_file: str = ""
    gain: list[float] = []
    offset: list[float] = []
    noise: float = 0.02
    resolution: float = 0.01
    seed: int = 0
    tick_hz: float = 200.0
    history: int = 64
    shape: tactile_nodes.ShapeSettings | None = None


class SimTactile(tactile_nodes.FingerDriver, TickDriver):
    """A simulated tactile array.

    Concurrency: the one thread of the driver process.
    """

    Settings = SimTactileSettings
    realtime_priority = 0

    @classmethod
    def describe(cls, name: str, settings: SimTactileSettings) -> Description:
        """Tell the elements and the nodes that are felt."""
        elements = _check(settings)
        what = "radial compression"
        if settings.model_file:
            what += f", model {zlib.crc32(read_bytes(Path(settings.model_file))):08x}"
        channels = tuple(ChannelInfo(f"e{index}", "%", description=what) for index in range(elements))
        felt = (
            settings.force_node,
            settings.angle_node,
            settings.curvature_node,
            *tactile_nodes.inputs(settings.shape),
        )
        return Description(
            (
                BlockSpec("", NodeClass.ANALOG, channels, history=settings.history),
                *tactile_nodes.specs(settings.shape, elements, settings.history),
            ),
            settings.tick_hz,
            tuple(dict.fromkeys(node for node in felt if node)),
            lease_s=1.0,
        )

    def __init__(self, name: str, settings: SimTactileSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self._make_blocks(self.describe(name, settings).blocks, settings.shape)
        self._array = _twin(settings) if settings.model_file else _array(settings)
        if settings.curvature_node and isinstance(self._array, TactileArray):
            self._array.mount_all()
        else:
            self._array.mount(settings.indenter_radius_m)
        self._touch: tuple[float | None, ...] = (None, None, None)
        self._seen: tuple[float | None, ...] = (None, None, None)

    def tick(self, now_ns: int) -> None:
        """Read force and angle; while a device is not there the reading is invalid."""
        settings = self.settings
        force, angle = self._value(settings.force_node, now_ns), self._value(settings.angle_node, now_ns)
        curvature = self._value(settings.curvature_node, now_ns)
        self._touch = force, angle, curvature
        contact_rad = settings.angle_rad + settings.angle_per_position * (angle or 0.0)
        radius_m = settings.indenter_radius_m
        if settings.curvature_node:
            radius_m = 1.0 / curvature if curvature else math.inf
        self._array.read(force or 0.0, contact_rad, radius_m, self._block.data, now_ns * 1e-9)
        missing = force is None or angle is None or curvature is None
        self._block.flags[:] = int(AnalogStatus.INVALID) if missing else 0
        if self._finger is not None:
            self._finger.take(self._block.data, self._block.flags, now_ns, now_ns)

    def is_at_rest(self) -> bool:
        """Whether the finger is touched as it was at the last look: noise that nobody sees need not be made."""
        at_rest, self._seen = self._touch == self._seen, self._touch
        return at_rest

    def _value(self, node: str, now_ns: int) -> float | None:
        """Return a node's value, 0 for no node, None while its device is not there or says that it is invalid."""
        if not node:
            return 0.0
        reading = self.kit.inputs[node].read(now_ns)
        if reading is None or ("flags" in reading and int(reading["flags"][0]) & int(AnalogStatus.INVALID)):
            return None
        return float(reading["value"][0])


def _check(settings: SimTactileSettings) -> int:
    """Return the number of elements.

    Raises:
        ValueError: numbers of another length than the elements, a radius that is no radius, or a model that cannot be
            read.
    """
    shape = from_table(FingerShape, settings.finger)
    elements = _twin(settings).count if settings.model_file else len(shape.angles_rad)
    if settings.curvature_node and settings.model_file:
        raise ValueError(
            "curvature_node: a finger with a model_file has a fixed indenter_radius_m; want one of the two"
        )
    for key, values in (("gain", settings.gain), ("offset", settings.offset)):
        if len(values) not in (0, elements):
            raise ValueError(f"{key}: {len(values)} numbers; want {elements}, one for each element")
    for key in ("noise", "resolution"):
        if not 0.0 <= getattr(settings, key) < math.inf:
            raise ValueError(f"{key} {getattr(settings, key):g}; want 0 or more, finite")
    if not math.isfinite(settings.angle_per_position):
        raise ValueError(f"angle_per_position {settings.angle_per_position:g}; want a finite number of rad")
    if not (settings.indenter_radius_m >= 0 and math.isfinite(settings.angle_rad)):
        raise ValueError(
            f"indenter_radius_m {settings.indenter_radius_m:g}, angle_rad {settings.angle_rad:g}; "
            "want a positive radius or 0 for an edge, a finite angle"
        )
    return elements


def _twin(settings: SimTactileSettings) -> TwinFinger:
    path, length_m = settings.model_file, from_table(FingerShape, settings.finger).length_m
    noise = (settings.noise, settings.resolution, settings.seed)
    try:
        made: TwinFinger = twin("finger")(toml_of(read_bytes(Path(path))), path, length_m, *noise)
        return made
    except OSError as error:
        raise ValueError(f"model_file {path}: {error.strerror}; sioms reconcile tactile writes one") from None
    except ValueError as error:
        raise ValueError(f"model_file {path}: {error}") from None


def _array(settings: SimTactileSettings) -> TactileArray:
    return TactileArray(
        from_table(FingerShape, settings.finger),
        settings.gain or 1.0,
        settings.offset or 0.0,
        settings.noise,
        settings.resolution,
        settings.seed,
    )


DRIVER = SimTactile
