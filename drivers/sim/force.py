"""A simulated six-component force/torque sensor that feels the contacts of simulated axes.

[device.force0]
driver = "sim-force"
noise = [0.05, 0.05, 0.08, 0.002, 0.002, 0.002]
[[device.force0.contact]]
node = "mod0.plant.zaxis_contact"
direction = [0, 0, -1]
point_m = [0.0, 0.02, 0.1]

``flaws_file`` names a TOML file of what it does beyond its data sheet (``sioms.plant.force_sensor.Flaws``), to be
hidden from who looks at the configuration. With a ``model_file``, as ``sioms reconcile force`` writes it,
the sensor is the twin of the one that the model was found for.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from sioms.documents import read_bytes, toml_of
from sioms.plant.force_sensor import COMPONENTS, Contact, Flaws, ForceSensor, Six
from sioms.plant.foreign import TwinForce, twin
from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, AnyBlock, BlockSpec, Description
from sioms.sdk.driver import Kit, TickDriver
from sioms.sdk.tables import from_table, table_type

Vector = tuple[float, float, float]


class ContactTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A contact that the sensor feels.

    Attributes:
        node: analog node of one channel with the contact force [N].
        direction: of the force on the sensor.
        point_m: of its application, from the sensor's origin.
    """

    node: str
    direction: Vector
    point_m: Vector = (0.0, 0.0, 0.0)


class SimForceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device; six values are fx, fy, fz [N], tx, ty, tz [N m].

    Attributes:
        contact: the contacts it feels.
        noise: standard deviations.
        resolution: steps of the readings, all positive, or none.
        bias: readings without load.
        limit: the readings saturate here.
        cross_talk: 6 rows of 6, applied to the true components.
        flaws_file: TOML file with flaws.
        model_file: sensor and effects from a model instead.
        seed: of the noise.
        tick_hz: rate.
        history: snapshots kept for readers.
    """

    contact: list[ContactTable] = []
    noise: Six = (0.05, 0.05, 0.08, 0.002, 0.002, 0.002)
    resolution: Six = (0.01, 0.01, 0.02, 0.0005, 0.0005, 0.0005)
    bias: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    limit: Six = (200.0, 200.0, 400.0, 10.0, 10.0, 10.0)
    cross_talk: tuple[Six, Six, Six, Six, Six, Six] | None = None
    flaws_file: str = ""
    model_file: str = ""
    seed: int = 0
    tick_hz: float = 1000.0
    history: int = 256


class SimForce(TickDriver):
    """A simulated force/torque sensor.

    Concurrency: the one thread of the driver process.
    """

    Settings = SimForceSettings
    realtime_priority = 0

    @classmethod
    def describe(cls, name: str, settings: SimForceSettings) -> Description:
        """Tell the six channels and the contact nodes."""
        _sensor(settings, _flaws(settings.flaws_file))
        what = ""
        if settings.model_file:
            what = f"model {zlib.crc32(read_bytes(Path(settings.model_file))):08x}"
        units = ("N",) * 3 + ("N*m",) * 3
        channels = tuple(
            ChannelInfo(component, unit, -limit, limit, description=what)
            for component, unit, limit in zip(COMPONENTS, units, settings.limit, strict=True)
        )
        inputs = tuple(dict.fromkeys(contact.node for contact in settings.contact))
        return Description(
            (BlockSpec("", NodeClass.ANALOG, channels, history=settings.history),), settings.tick_hz, inputs,
            lease_s=1.0,
        )  # fmt: skip

    def __init__(self, name: str, settings: SimForceSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self._block = AnalogBlock(self.describe(name, settings).blocks[0])
        self._sensor = _sensor(settings, _flaws(settings.flaws_file))
        self._twin = _twin(settings.model_file) if settings.model_file else None
        self._forces, self._seen = np.zeros((2, len(settings.contact)))
        self._limit = np.array(settings.limit)
        self._period_ns = round(1e9 / settings.tick_hz)
        self._last_ns = 0
        self._missing = self._rested = False

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The six components."""
        return (self._block,)

    def tick(self, now_ns: int) -> None:
        """Read the contacts; one whose device is not there presses nothing and makes the reading invalid.

        A sensor does not miss its samples because this machine was busy: after a late tick they are made up for, each
        with what pressed at its own time.
        """
        self._make_up(now_ns)
        missing = False
        for index, contact in enumerate(self.settings.contact):
            reading = self.kit.inputs[contact.node].read(now_ns)
            if reading is not None and "flags" in reading and int(reading["flags"][0]) & int(AnalogStatus.INVALID):
                reading = None
            missing |= reading is None
            self._forces[index] = 0.0 if reading is None else reading["value"][0]
        self._sample(now_ns, missing)
        self._last_ns, self._missing, self._rested = now_ns, missing, False

    def _make_up(self, now_ns: int) -> None:
        """Publish the samples that have been missed since the last tick, unless they were left out at rest."""
        late = (now_ns - self._last_ns) // self._period_ns - 1 if self._last_ns and not self._rested else 0
        if late <= 0:
            return
        news: list[tuple[int, str, float]] = []
        for node in dict.fromkeys(contact.node for contact in self.settings.contact):
            fresh = self.kit.inputs[node].fresh(now_ns)
            news += [(stamp_ns, node, float(reading["value"][0])) for stamp_ns, reading in fresh]
        news.sort()
        made_up = min(late, self.settings.history // 2)
        lost, at = int(AnalogStatus.OVERRUN) * (made_up < late), 0
        for number in range(made_up, 0, -1):
            sample_ns = now_ns - number * self._period_ns
            while at < len(news) and news[at][0] <= sample_ns:
                for index, contact in enumerate(self.settings.contact):
                    if contact.node == news[at][1]:
                        self._forces[index] = news[at][2]
                at += 1
            self._sample(sample_ns, self._missing)
            self._block.flags |= lost
            self.kit.publish(self._block, sample_ns)
            lost = 0

    def _sample(self, now_ns: int, missing: bool) -> None:
        data, sensor, time_s = self._block.data, self._sensor, now_ns * 1e-9
        if self._twin is None:
            sensor.read(self._forces, data, time_s)
        else:
            sensor.electronics(self._twin.read(sensor.load(self._forces), time_s), data)
        self._block.flags[:] = (np.abs(data) >= self._limit) * int(AnalogStatus.SATURATED)
        if missing:
            self._block.flags |= int(AnalogStatus.INVALID)

    def is_at_rest(self) -> bool:
        """Whether the contacts press as they did at the last look: noise that nobody sees need not be made."""
        self._rested = bool((self._forces == self._seen).all())
        self._seen[:] = self._forces
        return self._rested


def _sensor(settings: SimForceSettings, flaws: Flaws | None) -> ForceSensor:
    return ForceSensor(
        [Contact(contact.direction, contact.point_m) for contact in settings.contact],
        settings.noise,
        settings.resolution,
        settings.bias,
        settings.limit,
        None if settings.cross_talk is None else np.array(settings.cross_talk),
        settings.seed,
        flaws,
    )


def _flaws(path: str) -> Flaws | None:
    if not path:
        return None
    try:
        table = toml_of(read_bytes(Path(path)))
        return from_table(Flaws, msgspec.convert(table, table_type(Flaws)))
    except (OSError, ValueError, msgspec.ValidationError) as error:
        raise ValueError(f"flaws_file {path}: {error}") from None


def _twin(path: str) -> TwinForce:
    made: TwinForce = twin("force")(toml_of(read_bytes(Path(path))), path, COMPONENTS)
    return made


DRIVER = SimForce
