"""What each finger of a hand feels by itself, from wrist sensors or the fingers' own estimates: `HandDriver`'s table
``touch``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec

from sioms.hand.felt import felt
from sioms.hand.model import HandModel
from sioms.hand.yielding import Push, push_of
from sioms.sdk.blocks import unfit
from sioms.sdk.driver import InputNode
from sioms.sdk.inputs import NotMeasuredError
from sioms.tactile.sensing import CHANNELS

CONTACT_S = 0.1
"""How long a finger that bounces still counts as touching [s], of the hand's time."""
BOUNDS = {
    "length_m": (1e-4, 1.0), "contact_n": (1e-6, 1e3), "damper": (1e-9, 1e4), "filter_s": (0.0, 1e4),
    "age_max_s": (1e-4, 3600.0),
}  # fmt: skip
SHOWN = (
    *((f"touched{i}", "", f"1 while finger {i} touches something, 0 while nothing") for i in (1, 2)),
    *((f"force{i}", "N", f"with which finger {i} presses") for i in (1, 2)),
    *((f"angle{i}", "rad", f"from finger {i} into what it presses on, in the axes of the platen") for i in (1, 2)),
    ("age", "s", "of the older reading"),
)


class TouchTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How fingers yield, each by itself, under a greatest force.

    Attributes:
        wrists: nodes of two force sensors with the axes of the platen; their fx and fy are read first.
        fingers: nodes ``shape`` of the two fingers instead.
        length_m: of the contact along a finger: force over line load.
        contact_n: force from which on a finger touches something [N]: above noise and drift of the readings.
        damper: how fast a finger goes into what it feels, per newton below the greatest force [m/(s N)].
        filter_s: time constant of the force's low-pass [s].
        age_max_s: an older reading is none.
    """

    wrists: tuple[str, str] | None = None
    fingers: tuple[str, str] | None = None
    length_m: float = 20e-3
    contact_n: float = 0.015
    damper: float = 0.2
    filter_s: float = 0.005
    age_max_s: float = 0.05

    @property
    def nodes(self) -> tuple[str, ...]:
        """Return what is read."""
        return self.wrists or self.fingers or ()


def check(touch: TouchTable) -> None:
    """Refuse what tells no force.

    Raises:
        ValueError: with a sentence.
    """
    if (touch.fingers is None) == (touch.wrists is None):
        raise ValueError("touch: has neither or both of fingers and wrists; want one of them")
    for key, (least, most) in BOUNDS.items():
        if not least <= getattr(touch, key) <= most:
            raise ValueError(f"touch: {key} {getattr(touch, key):g}; want {least:g} to {most:g}")


class Touching:
    """Reads what each finger feels.  One caller at a time.

    Args:
        touch: checked.
        inputs: pages of its nodes.
        model: what the hand is known to be.
        pace: of the hand's time.

    Attributes:
        why: why nothing is known; empty when it is.
        age_s: of the older reading.
    """

    def __init__(self, touch: TouchTable, inputs: Mapping[str, InputNode], model: HandModel, pace: float) -> None:
        self._touch, self._inputs, self._model = touch, inputs, model
        self._felt = [[0.0, 0.0], [0.0, 0.0]]  # forces of the object on both fingers, filtered
        self._last_ns, self._contact_ns = 0, -1
        self._lasts_ns = round(CONTACT_S / pace * 1e9)
        self.why, self.age_s = "not read yet", math.inf

    def take(self, now_ns: int, turns: Sequence[float]) -> None:
        """Read both fingers.

        Args:
            now_ns: time of the tick.
            turns: angles of both links [rad].
        """
        try:
            forces = [self._read(i, now_ns, turns[i]) for i in (0, 1)]
        except NotMeasuredError as unknown:
            self.why, self._last_ns = str(unknown), 0
            return
        self.why = ""
        passed_s, time_s = (now_ns - self._last_ns) * 1e-9, self._touch.filter_s
        share = 1.0 if not self._last_ns or time_s == 0.0 else -math.expm1(-passed_s / time_s)
        self._last_ns = now_ns
        for held, now in zip(self._felt, forces, strict=True):
            for i in (0, 1):
                held[i] += share * (now[i] - held[i])
        if any(self.pushes):
            self._contact_ns = now_ns

    @property
    def pushes(self) -> tuple[Push | None, Push | None]:
        """What each finger feels, None where it touches nothing."""
        one, two = (push_of(*force) for force in self._felt)
        least = self._touch.contact_n
        return (one if one.force > least else None), (two if two.force > least else None)

    def touched(self, now_ns: int) -> bool:
        """Return whether a finger touches something, or has a moment ago."""
        return self._contact_ns >= 0 and now_ns - self._contact_ns <= self._lasts_ns

    def shown(self) -> tuple[float, ...]:
        """Return the channels `SHOWN`."""
        if self.why:
            return (math.nan,) * len(SHOWN)
        one, two = (push_of(*force) for force in self._felt)
        touched = (float(push is not None) for push in self.pushes)
        return *touched, one.force, two.force, one.angle, two.angle, self.age_s

    def _read(self, index: int, now_ns: int, turn: float) -> tuple[float, float]:
        """Return the force of the object on a finger, along the axes of the platen.

        Raises:
            NotMeasuredError: it is not known, and why.
        """
        touch, node = self._touch, self._touch.nodes[index]
        reading = self._inputs[node].read(now_ns)
        if reading is None:
            raise NotMeasuredError(f"{node}: it cannot be read; want its device up")
        age_s = (now_ns - self._inputs[node].stamp_ns) * 1e-9
        if age_s > touch.age_max_s:
            raise NotMeasuredError(f"{node}: its reading is {age_s:.3f} s old; want {touch.age_max_s:g} s")
        self.age_s = age_s if index == 0 else max(age_s, self.age_s)
        value = reading["value"]
        if touch.wrists:
            if len(value) < 2:
                raise NotMeasuredError(f"{node}: it has {len(value)} channels; want fx and fy of a wrist")
            if unfit(reading["flags"][:2], value[:2]).any():
                raise NotMeasuredError(f"{node}: its force is invalid or saturated; want one that may be relied on")
            return float(value[0]), float(value[1])
        if len(value) != len(CHANNELS):
            raise NotMeasuredError(f"{node}: it has {len(value)} channels; want the shape of a calibrated finger")
        found = self._model.corrected(felt(value.tolist(), touch.length_m), index)
        if found.touched is None:
            raise NotMeasuredError(f"{node}: the finger cannot tell whether anything touches it")
        angle = turn + found.phi
        return (-found.force * math.cos(angle), -found.force * math.sin(angle)) if found.touched else (0.0, 0.0)
