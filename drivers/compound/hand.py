"""A hand: two modules with a finger each; coordinates x, y, psi, d, phi1 and phi2 (sioms.hand.kinematics).

A device made of devices, see drivers/compound/README.md. With a table ``squeeze`` d takes force commands: an internal
force [N], positive squeezes. In free space d then yields as a virtual spring about where it was, in contact it follows
the damper law (sioms.hand.control), with the force that the fingers' own estimates or wrist sensors tell. With a table
``touch`` commands of d may say a greatest force: as long as it holds, each finger yields by itself
(sioms.hand.yielding), and the node ``touch`` shows what each feels. The node
``force`` shows that force and how late all this is, the node ``model`` what the hand is known to be: what is stated, or
what ``model_file`` says, which ``sioms reconcile hand`` writes. hand.toml is an example without a sense of
touch, etc/hand.toml a whole hand with fingers that feel.

Lengths in metres, angles in radians.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import msgspec

from sioms.documents import read_text
from sioms.hand.control import Controller, Gains
from sioms.hand.felt import felt, internal_force, wrist_force
from sioms.hand.kinematics import COORDINATES, LINK_M, LONGEST_M, UNITS, Hand
from sioms.hand.model import HandModel, model_of
from sioms.hand.statics import damped_limit, filtered_limit
from sioms.hand.yielding import yielded
from sioms.motion.axis_step import FORCE
from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, AnyBlock, BlockSpec, Description, unfit
from sioms.sdk.driver import Kit
from sioms.sdk.inputs import NotMeasuredError
from sioms.tactile.sensing import CHANNELS

from . import touching
from .compound import Compound, CompoundSettings
from .readings import Reading
from .touching import Touching, TouchTable

D, PSI = COORDINATES.index("d"), COORDINATES.index("psi")
_TH = (2, 5)
_BEND_S = 0.05
"""Time constant of the bend of a link in its torque, in the hand's own time [s]: a servo that chases its encoder's
steps does not shake d."""
_INVALID = int(AnalogStatus.INVALID)
_BOUNDS = {
    "link1_m": (1e-3, LONGEST_M), "link2_m": (1e-3, LONGEST_M), "least_m": (1e-6, 1.0),
    "link_stiffness": (1e-6, math.inf), "pace": (1e-3, 1.0),
}  # fmt: skip
_SQUEEZE_BOUNDS = {
    "length_m": (1e-4, 1.0), "damper": (1e-9, 1e4), "spring_rate": (1e-6, 1e4), "spring": (1e-6, 1e9),
    "filter_s": (0.0, 1e4), "opening_max": (1e-9, 1e2), "contact_n": (0.0, 1e3), "stiffness": (1e-6, 1e9),
    "damping": (0.0, 1e6), "age_max_s": (1e-4, 3600.0),
}  # fmt: skip
MODEL_CHANNELS = (
    *((f"link{i}", "m", "length of a link") for i in (1, 2)),
    *((f"mount{i}", "rad", "angle by which a finger is turned on its link") for i in (1, 2)),
    *((f"stiffness{i}", "N*m/rad", "of a link and its finger behind the encoder") for i in (1, 2)),
    *((f"gain{i}", "", "relative departure of the load that a finger tells") for i in (1, 2)),
    ("friction", "", "least coefficient, to be relied on"),
)
_CHANNELS = (
    ("force", "N", "internal force, from what `squeeze` reads; positive squeezes"),
    ("filtered", "N", "the same behind the law's low-pass"),
    ("force_age", "s", "age of the older of its two readings"),
    ("late", "s", "age of the oldest position of a held axis"),
    ("loop", "s", "from the stamp of the newest force reading to the axes' commands of this tick"),
    ("pace", "", "of its time: below 1 for a simulated hand in slow motion"),
)


class SqueezeTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the hand squeezes.

    Attributes:
        fingers: nodes ``shape`` of the two fingers; their loads are the force.
        wrists: nodes of two force sensors instead, with the axes of the platen; their fx and fy are read first.
        length_m: of the contact along a finger: force over line load.
        damper: K_v [m/(s N)].
        spring_rate, spring: K_d [1/s] and K_s [N/m] of the virtual spring.
        filter_s: time constant of the force's low-pass [s].
        opening_max: fastest d opens or closes by these laws [m/s].
        contact_n: force from which on there is contact [N].
        by: what moves: "links" alone, whose axes are soft, or "carriages".
        stiffness, damping: of everything between d and the force [N/m, N s/m]: K_v above what they allow is refused.
        age_max_s: an older reading is none.
    """

    fingers: tuple[str, str] | None = None
    wrists: tuple[str, str] | None = None
    length_m: float = 20e-3
    damper: float = 0.4
    spring_rate: float = 5.0
    spring: float = 100.0
    filter_s: float = 0.05
    opening_max: float = 0.1
    contact_n: float = 0.02
    by: Literal["links", "carriages"] = "links"
    stiffness: float = 7.0
    damping: float = 0.6
    age_max_s: float = 0.05


class HandSettings(CompoundSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of a hand.

    Attributes:
        link1_m, link2_m: from the revolute axis of a module to its finger's centre.
        model_file: what the hand is known to be (sioms.hand.model); its links and stiffnesses replace the stated ones.
        least_m: the least d that has a direction; how far the hand may close says the d of the coordinates.
        link_stiffness: of each link and its finger behind the encoder of its axis [N m/rad]; infinite: none gives.
        squeeze: how it squeezes; without it d takes no force commands.
        touch: how fingers yield, each by itself; without it commands of d say no greatest force.
        pace: of a simulated hand in slow motion, see sioms.hand.slow: what takes 1 s there takes 1/pace s here.
    """

    link1_m: float = LINK_M
    link2_m: float = LINK_M
    model_file: str = ""
    least_m: float = 1e-3
    link_stiffness: float = math.inf
    squeeze: SqueezeTable | None = None
    touch: TouchTable | None = None
    pace: float = 1.0
    tick_hz: float = 400.0


class HandDriver(Compound):
    """Held axes: x, y and th of module 1, then of module 2.

    Concurrency: the one thread of the driver process.
    """

    Settings = HandSettings
    COORDINATES: ClassVar = dict(zip(COORDINATES, UNITS, strict=True))

    @classmethod
    def transform(cls, settings: HandSettings) -> Hand:
        """Return the map."""
        return known(settings).maps(settings.least_m)

    @classmethod
    def presses(cls, settings: HandSettings, axis: Any) -> bool:
        """Return whether a coordinate takes force commands: d does."""
        return axis.name == "d" and settings.squeeze is not None

    @classmethod
    def yields(cls, settings: HandSettings, axis: Any) -> bool:
        """Return whether a command may say a greatest force: of d, which holds for both fingers."""
        return axis.name == "d" and settings.touch is not None

    @classmethod
    def describe(cls, name: str, settings: HandSettings) -> Description:
        """Tell the coordinates and the forces."""
        base = super().describe(name, settings)
        for key, (least, most) in _BOUNDS.items():
            if not least <= getattr(settings, key) <= most:
                raise ValueError(f"{key} {getattr(settings, key):g}; want {least:g} to {most:g}")
        if any(axis.force_node for axis in settings.axis):
            raise ValueError("axis: has a force_node; want the table squeeze, which says from where the force comes")
        model = _spec("model", _model_channels(settings), settings.history)
        blocks, nodes = list(base.blocks), list(base.inputs)
        if settings.squeeze is not None:
            _check(settings.squeeze, settings)
            blocks.append(_spec("force", _CHANNELS, settings.history))
            nodes += _nodes(settings.squeeze)
        if settings.touch is not None:
            touching.check(settings.touch)
            blocks.append(_spec("touch", touching.SHOWN, settings.history))
            nodes += settings.touch.nodes
        return Description((*blocks, model), base.tick_hz, tuple(dict.fromkeys(nodes)), holds=base.holds)

    def __init__(self, name: str, settings: HandSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        squeeze, self._model = settings.squeeze, known(settings)
        self._controller = Controller(_gains(squeeze, settings)) if squeeze is not None else None
        shown = {spec.name: AnalogBlock(spec) for spec in self.describe(name, settings).blocks[1:]}
        self._shown_force, self._shown_touch = shown.get("force"), shown.get("touch")
        self._shown_model = shown["model"]
        touch = settings.touch
        self._touching = Touching(touch, kit.inputs, self._model, settings.pace) if touch is not None else None
        self._shown_model.data[:] = numbers(self._model)
        self._force: float | None = None
        self._why = "not read yet"
        self._force_age_s = math.inf
        self._touches = False
        self._was_ns = self._newest_ns = 0
        self._about: float | None = None  # d about which the spring yields
        self._bend = [0.0, 0.0]
        self._bent_ns = 0

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The coordinates, the forces, and what the hand is known to be."""
        forces = [block for block in (self._shown_force, self._shown_touch) if block is not None]
        return (self._block, *forces, self._shown_model)

    def tick(self, now_ns: int) -> None:
        """Take the force, then as any device made of devices."""
        seen_ns = self._newest_ns
        if self._controller is not None:
            self._feel(self._controller, now_ns)
        if self._touching is not None:
            self._touching.take(now_ns, self._turns())
        super().tick(now_ns)
        if self._shown_force is not None:
            self._show(self._shown_force, now_ns, self._newest_ns != seen_ns)
        if self._shown_touch is not None and self._touching is not None:
            self._shown_touch.data[:] = self._touching.shown()
            self._shown_touch.flags[:] = _INVALID if self._touching.why else 0

    def bent(self, taken: Reading) -> list[float]:
        """Return the joints with the links turned by what their drives' torques bend them."""
        joints, passed_s = taken.joints, (taken.stamp_ns - self._bent_ns) * 1e-9
        self._bent_ns = taken.stamp_ns
        share = 1.0 - math.exp(-passed_s * self.settings.pace / _BEND_S)
        for n, i in enumerate(_TH):
            self._bend[n] += share * (taken.load[i] / self._model.joint_stiffness[n] - self._bend[n])
            joints[i] -= self._bend[n]
        return joints

    def pressing(self, index: int, wanted: float, now_ns: int) -> float:
        """Return the velocity of d: by the damper law in contact, as a spring about where it was in free space.

        Raises:
            NotMeasuredError: no force is known.
        """
        if self._force is None or self._controller is None:
            raise NotMeasuredError(self._why)
        d = self._at[D]
        if self._about is None or self._touches:
            self._about = d
        return self._controller.opening(self._about, 0.0, d, wanted, self._touches)

    def _wanted(self, now_ns: int) -> list[float]:
        """Return the velocities of the coordinates; under a greatest force no finger presses harder than that.

        What holds a finger back is an error that would be brought back ever harder: none is, meanwhile.
        """
        touch, table = self._touching, self.settings.touch
        most_n = float(self.bank.arrays["force_limit"][D])
        if touch is None or not most_n < self.settings.axis[D].force_max:
            return self._squeezed(now_ns)
        if touch.why:
            self.bank.fault(self._all, f"axis d: no force is known: {touch.why}", now_ns)
            return [0.0] * self.bank.n
        if touch.touched(now_ns):
            self._errors = [0.0] * self.bank.n
        fastest = float(self.bank.arrays["velocity_limit"][D])
        return list(yielded(self._squeezed(now_ns), self._at, touch.pushes, most_n, table.damper, fastest))

    def _turns(self) -> tuple[float, float]:
        """Return the angles of both links, as of the last tick."""
        if not self._at:
            return 0.0, 0.0
        _, _, psi, _, phi1, phi2 = self._at
        return psi - phi1, psi - phi2 + math.pi

    def _squeezed(self, now_ns: int) -> list[float]:
        """Return the velocities of the coordinates; in contact the links alone squeeze."""
        wanted = super()._wanted(now_ns)
        controller = self._controller
        if controller is None or self.bank.arrays["kind"][D] != FORCE:
            self._about = None
            return wanted
        if self._touches and controller.gains.link_m:
            x, y, psi, turn1, turn2 = controller.by_links(wanted[D], self._at)
            for i, by in zip((0, 1, 2, 4, 5), (x, y, psi, turn1, turn2), strict=True):
                wanted[i] += by
        return wanted

    def _feel(self, controller: Controller, now_ns: int) -> None:
        """Read the force; remember why there is none."""
        squeeze: SqueezeTable = self.settings.squeeze
        sample_s = max((now_ns - self._was_ns) * 1e-9, 0.1 / self.settings.tick_hz) if self._was_ns else 0.0
        self._was_ns = now_ns
        rows, oldest_ns, newest_ns = [], now_ns, 0
        self._force = None
        for node in _nodes(squeeze):
            reading = self.kit.inputs[node].read(now_ns)
            if reading is None:
                self._why = f"{node}: it cannot be read; want its device up"
                return
            count = len(reading["value"])
            if count != len(CHANNELS) if squeeze.fingers else count < 2:
                kind = "the shape of a finger that has a calibration" if squeeze.fingers else "fx and fy of a wrist"
                self._why = f"{node}: it has {count} channels; want {kind}"
                return
            stamp_ns = self.kit.inputs[node].stamp_ns
            oldest_ns, newest_ns = min(oldest_ns, stamp_ns), max(newest_ns, stamp_ns)
            if now_ns - stamp_ns > squeeze.age_max_s * 1e9:
                self._why = f"{node}: its reading is {(now_ns - stamp_ns) * 1e-9:.3f} s old; want {squeeze.age_max_s} s"
                return
            if (
                squeeze.wrists and unfit(reading["flags"][:2], reading["value"][:2]).any()
            ):  # a finger tells it by itself
                self._why = f"{node}: its force is invalid or saturated; want one that may be relied on"
                return
            rows.append(reading)
        self._force_age_s, self._newest_ns = (now_ns - oldest_ns) * 1e-9, newest_ns
        self._force = _internal(squeeze, [row["value"] for row in rows], self._at, self._model)
        if self._force is None:
            self._why = "a finger cannot tell whether anything touches it"
            return
        self._touches = controller.feel(self._force, sample_s)

    def _show(self, block: AnalogBlock, now_ns: int, is_new: bool) -> None:
        """Fill the node ``force``."""
        force, felt_n = self._force, self._controller.felt if self._controller else 0.0
        block.flags[:2] = 0 if force is not None else _INVALID
        loop_s = (self.kit.now_ns() - self._newest_ns) * 1e-9 if is_new and self._drives else math.nan
        block.flags[4] = 0 if math.isfinite(loop_s) else _INVALID
        late_s = (now_ns - self._block.stamp_ns) * 1e-9
        block.data[:] = (
            math.nan if force is None else force, felt_n, self._force_age_s, late_s, loop_s, self.settings.pace
        )  # fmt: skip


def _nodes(squeeze: SqueezeTable) -> tuple[str, ...]:
    return squeeze.fingers or squeeze.wrists or ()


def known(settings: HandSettings) -> HandModel:
    """Return what the hand is known to be.

    Raises:
        ValueError: a number out of its range, or a model that cannot be read or is none.
    """
    Hand(settings.link1_m, settings.link2_m)  # says by its key what it refuses
    if not settings.link_stiffness > 0.0:
        raise ValueError(f"link_stiffness {settings.link_stiffness:g} N m/rad; want more than 0")
    stated = HandModel((settings.link1_m, settings.link2_m), joint_stiffness=(settings.link_stiffness,) * 2)
    if not settings.model_file:
        return stated
    try:
        return model_of(read_text(Path(settings.model_file)), stated)
    except OSError as error:
        why = f"{error.strerror}; sioms reconcile hand writes one"
    except ValueError as error:
        why = str(error)
    raise ValueError(f"model_file {settings.model_file}: {why}")


def numbers(model: HandModel) -> tuple[float, ...]:
    """Return a model as the node ``model`` shows it."""
    return (*model.link_m, *model.mount_rad, *model.joint_stiffness, *model.load_gain, model.friction)


def _model_channels(settings: HandSettings) -> Iterator[tuple[str, str, str]]:
    """Yield the channels of the node ``model``; which file it is of, so that a reload sees another."""
    file = settings.model_file
    of = f", model {zlib.crc32(repr(known(settings)).encode()):08x}" if file else ""
    for name, unit, what in MODEL_CHANNELS:
        yield name, unit, what + of


def _spec(name: str, channels: Iterable[tuple[str, str, str]], history: int) -> BlockSpec:
    told = tuple(ChannelInfo(channel, unit, description=what) for channel, unit, what in channels)
    return BlockSpec(name, NodeClass.ANALOG, told, history=history)


def _internal(
    squeeze: SqueezeTable, rows: Sequence[Any], at: Sequence[float], model: HandModel
) -> float | None:  # fmt: skip
    one, two = rows
    if squeeze.fingers:
        feels = [model.corrected(felt(row.tolist(), squeeze.length_m), i) for i, row in enumerate(rows)]
        return internal_force(*feels)
    return wrist_force(one[:2].tolist(), two[:2].tolist(), at[PSI], squeeze.contact_n) if at else 0.0


def _gains(squeeze: SqueezeTable, settings: HandSettings) -> Gains:
    """Return the gains of the law.

    Raises:
        ValueError: one that cannot be.
    """
    d = settings.axis[D]
    link_m = 0.5 * (settings.link1_m + settings.link2_m) if squeeze.by == "links" else 0.0
    return Gains(
        position=d.gain, spring_rate=squeeze.spring_rate, spring=squeeze.spring, damper=squeeze.damper,
        filter_s=squeeze.filter_s, opening_max=squeeze.opening_max, contact_n=squeeze.contact_n, link_m=link_m,
    )  # fmt: skip


def _check(squeeze: SqueezeTable, settings: HandSettings) -> None:
    """Refuse what cannot squeeze.

    Raises:
        ValueError: with a sentence.
    """
    if (squeeze.fingers is None) == (squeeze.wrists is None):
        raise ValueError("squeeze: has neither or both of fingers and wrists; want one of them")
    for key, (least, most) in _SQUEEZE_BOUNDS.items():
        if not least <= getattr(squeeze, key) <= most:
            raise ValueError(f"squeeze: {key} {getattr(squeeze, key):g}; want {least:g} to {most:g}")
    _gains(squeeze, settings)
    sample_s = 1.0 / settings.tick_hz
    limits = damped_limit(squeeze.stiffness, squeeze.damping, sample_s), filtered_limit(squeeze.filter_s, sample_s)
    if not squeeze.damper < min(limits):
        raise ValueError(
            f"squeeze: damper {squeeze.damper:g} m/(s N) is unstable at {settings.tick_hz:g} Hz with a stiffness of "
            f"{squeeze.stiffness:g} N/m, a damping of {squeeze.damping:g} N s/m and filter_s {squeeze.filter_s:g}; "
            f"want below {min(limits):.3g}"
        )


DRIVER = HandDriver
