"""What a skill sees of a hand and what it asks of it, tick by tick; how it may do it, and how it fails.

A skill runs alike on a simulated plane and on a node: it takes a `Reading` a tick and answers with a `Setpoint`, for
which `control.Controller` computes the joints' rates. Neither knows a process or a clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from sioms.hand.contacts import FINGER_M, LEAST_FRICTION, Grasp, Likeness
from sioms.hand.kinematics import Six


@dataclass(frozen=True, slots=True)
class Felt:
    """What one finger feels; immutable.

    Args:
        touched: whether something touches; None while that is not known.
        phi: place of the contact in the finger's own angle [rad]; nan without contact.
        phi_deviation: its standard deviation [rad].
        force: of the contact, along its normal [N]; 0 without contact.
        radius_m: R of the contact, 1/R = 1/rb + 1/rc; nan without contact.
        radius_deviation_m: its standard deviation.
        doubt: why the numbers are not to be relied on; empty when they are.
    """

    touched: bool | None
    phi: float = math.nan
    phi_deviation: float = math.nan
    force: float = 0.0
    radius_m: float = math.nan
    radius_deviation_m: float = math.nan
    doubt: str = ""


@dataclass(frozen=True, slots=True)
class Reading:
    """What is known of the hand at a tick; immutable.

    Args:
        time_s: since some start.
        joints: x1, y1, th1, x2, y2, th2 as the axes' encoders read them [m, m, rad].
        fingers: what each feels.
        ages_s: of the two frames from which that comes, at this tick.
        calibrated: whether each finger has a calibration.
        light: what each finger feels of the lightest touches, where that is told by something else: wrists, means of
            frames.
    """

    time_s: float
    joints: Six
    fingers: tuple[Felt, Felt]
    ages_s: tuple[float, float] = (0.0, 0.0)
    calibrated: tuple[bool, bool] = (True, True)
    light: tuple[Felt, Felt] | None = None


@dataclass(frozen=True, slots=True)
class Setpoint:
    """What the hand shall do until the next tick; immutable.

    Args:
        goal: the six coordinates [m, rad]; d counts in free space only.
        along: the rates at which the goal moves [m/s, rad/s].
        force: internal force [N]; below 0 lets go.
        frozen: the joints stay where they are, whatever the rest says.
        most_n: greatest force of each finger by itself [N]: beyond it the finger yields. Infinite: none does.
    """

    goal: Six
    along: Six
    force: float
    frozen: bool = False
    most_n: float = math.inf


_MANNERS = {
    "force_n": (1e-3, 1e3), "light_n": (1e-3, 1e3), "closing": (1e-5, 1.0), "moving": (1e-5, 1.0),
    "turning": (1e-4, 100.0), "rolling": (1e-4, 100.0), "gain": (1e-3, 1e3), "close_s": (1e-3, 1e5),
    "roll_s": (1e-3, 1e5), "clearance_m": (1e-4, 0.1), "tolerance_rad": (1e-6, 1.0), "held_rad": (0.0, 1.0),
    "frames": (1, 100_000), "light_rad": (0.0, math.pi), "squeeze_rad": (0.0, math.pi), "friction": (1e-3, 100.0),
    "most_n": (1e-3, 1e3), "lost_s": (1e-3, 100.0), "stale_s": (1e-3, 100.0), "regrasps": (0, 1000),
    "let_rad": (0.0, 1.0), "tap_n": (1e-3, 1e3), "taps": (0, 1000), "tap_frames": (1, 100_000), "yield_n": (1e-3, 1e3),
}  # fmt: skip
"""Bounds of how a skill may be done."""


class State(Enum):
    """Where a skill is."""

    IDLE = "idle"
    OPEN = "open"
    CLOSE = "close"
    SENSE = "sense"
    CLASSIFY = "classify"
    FEEL = "feel"
    REGRASP = "regrasp"
    ROLL = "roll"
    HOLD = "hold"
    FAULT = "fault"


class Fault(Enum):
    """Why a skill ended or was refused."""

    LOST_CONTACT = "lost contact"
    CONE = "friction cone"
    ARRAY_END = "end of the array"
    OVERLOAD = "overload"
    STALE = "stale sensor"
    DOUBTFUL = "doubtful sensor"
    UNCALIBRATED = "not calibrated"
    NOTHING_THERE = "nothing there"
    TOO_LARGE = "too large"
    TOO_SMALL = "too small"
    NOT_CONVEX = "not convex"
    OUT_OF_REACH = "out of reach"
    SINGULAR = "singular"
    NOT_PARALLEL = "not parallel"
    HALTED = "hand halted"

    @property
    def opens(self) -> bool:
        """Whether the hand lets go; else it freezes where it is."""
        return self in (Fault.CONE, Fault.OVERLOAD, Fault.TOO_SMALL, Fault.NOTHING_THERE)


class Failed(Exception):
    """A skill cannot go on, or is refused.

    Args:
        fault: why.
        text: one sentence: what was attempted, what is wrong, what would be right.
    """

    def __init__(self, fault: Fault, text: str) -> None:
        super().__init__(text)
        self.fault = fault


@dataclass(frozen=True, slots=True)
class Event:
    """Something that a skill has to say; immutable.

    Args:
        time_s: of the reading.
        state: of the skill.
        text: what happened.
        fault: what it warns of, or why the skill ended.
    """

    time_s: float
    state: State
    text: str
    fault: Fault | None = None


@dataclass(frozen=True, slots=True)
class Manner:
    """How the skills do it; immutable.  The source gives none of these numbers.

    Args:
        force_n: internal force of a grasp [N].
        light_n: with which a grasp is felt before it is squeezed [N].
        closing: speed of the closing finger [m/s].
        moving, turning: speeds in free space [m/s, rad/s].
        rolling: largest |phi'| while an object is rolled [rad/s].
        gain: of the rolling law, towards the end [1/s].
        close_s: how long it closes at most [s], whatever bounces.
        roll_s: how long it rolls at most [s]; a wedge of two sides may never become parallel.
        clearance_m: by which each finger leaves the object before it moves.
        tolerance_rad: |eta| of a grasp that counts as parallel.
        held_rad: |eta| up to which a grasp is held without another regrasp or roll; holding corrects it.
        let_rad: |eta| that holding lets be: what sticks to the platen goes by jumps, and swings when all is corrected.
        frames: averaged where a grasp is sensed.
        light_rad: |eta| from which on it warns of the friction cone.
        squeeze_rad: |eta| from which on a touch is not squeezed, but regrasped as it is.
        friction: coefficient that is relied on.
        arc: places of contact between which a finger may be rolled [rad].
        most_n: force beyond which the hand lets go [N].
        lost_s, stale_s: how long a contact may be missing, a frame old [s].
        regrasps: at most so many.
        tap_n: with which one finger touches what lies on the platen [N]; less than moves it.
        taps: pairs of such touches before a regrasp, at most; 0 for none.
        tap_frames: averaged where such a touch is sensed.
        yield_n: force beyond which a finger yields that touches alone [N].
        smallest: roll towards the smallest diameter, as the source does; else towards the nearest parallel grasp.
        opening: least and largest d [m].
        reach: of the carriages, x and y from and to [m].
    """

    force_n: float = 1.0
    light_n: float = 0.2
    closing: float = 0.02
    moving: float = 0.06
    turning: float = 1.0
    rolling: float = 0.35
    gain: float = 2.5
    close_s: float = 30.0
    roll_s: float = 30.0
    clearance_m: float = 8e-3
    tolerance_rad: float = math.radians(0.3)
    held_rad: float = math.radians(1.0)
    let_rad: float = 0.0
    frames: int = 40
    light_rad: float = math.radians(30.0)
    squeeze_rad: float = math.radians(45.0)
    friction: float = LEAST_FRICTION
    arc: tuple[float, float] = (math.radians(14.0), math.radians(134.0))
    most_n: float = 4.0
    lost_s: float = 0.15
    stale_s: float = 0.1
    regrasps: int = 4
    tap_n: float = 0.04
    taps: int = 14
    tap_frames: int = 80
    yield_n: float = 0.08
    smallest: bool = False
    opening: tuple[float, float] = (2.0 * FINGER_M + 5e-3, 0.2)
    reach: tuple[float, float, float, float] = (-0.4, 0.4, -0.6, 0.6)

    def __post_init__(self) -> None:
        """Refuse what no hand can do.

        Raises:
            ValueError: with a sentence.
        """
        for name, (least, most) in _MANNERS.items():
            if not least <= getattr(self, name) <= most:
                raise ValueError(f"use hand: {name} is {getattr(self, name):g}; want {least:g} to {most:g}")
        if not self.force_n <= self.most_n:
            raise ValueError(f"use hand: force_n is {self.force_n:g} N; want at most {self.most_n:g} N, an overload")
        left, right, bottom, top = self.reach
        for name, low, high in (
            ("arc", *self.arc), ("opening", *self.opening), ("reach, along x,", left, right),
            ("reach, along y,", bottom, top),
        ):  # fmt: skip
            if not -math.inf < low < high < math.inf:
                raise ValueError(f"use hand: {name} is {low:g} to {high:g}; want two finite numbers that rise")


@dataclass(frozen=True, slots=True)
class Sensed:
    """What a grasp is like; immutable.

    Args:
        grasp: contacts and friction angles, of the mean of the frames.
        deviation: standard deviation of a friction angle [rad].
        curvatures: 1/rc of the object at each contact [1/m], as its sensor says it; 0 for a side.
        curvature_deviations: their standard deviations.
        places: phi_c [rad].
        force: internal force [N].
        likeness: what the object answers like.
    """

    grasp: Grasp
    deviation: float
    curvatures: tuple[float, float]
    curvature_deviations: tuple[float, float]
    places: tuple[float, float]
    force: float
    likeness: Likeness
