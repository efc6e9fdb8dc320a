"""What an estimate of a touch says, and how good it is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, Flag, auto


class Quality(Flag):
    """Say what is wrong with an estimate."""

    GOOD = 0
    NO_CONTACT = auto()  # the strains do not rise above the noise: nothing is estimated
    BAD_ELEMENTS = auto()  # some elements are dead, saturated or not finite and were left out
    TOO_FEW_ELEMENTS = auto()  # fewer than four usable elements near the touch: nothing is estimated
    POOR_FIT = auto()  # one round contact does not explain the strains: two contacts, a strange shape, a drifted finger
    OUT_OF_ARC = auto()  # beyond the outermost elements
    OVERLOAD = auto()  # wider or heavier than the model covers
    SHARP = auto()  # the width is at its lower bound: an edge, or a load too small to tell
    FLAT_OR_HOLLOW = auto()  # R is not below rb: no convex indenter does that
    NOT_CONVERGED = auto()
    WRONG_SIGN = auto()  # the strains are those of a pull
    IMPRECISE = auto()  # four standard deviations of the best fit's place are over 2 degrees: means are given instead
    NO_BASELINE = auto()  # the readings without touch are not known yet: nothing is estimated
    WITHOUT_LOAD = auto()  # the force sensor's load was not there, too old, or did not press: fitted without it
    BLIND = auto()  # whether anything touches is not known: the elements that are left cannot say
    SUSPECT = auto()  # one touch explains the strains only without one element, or without a shift of all: fitted so
    SLOW = auto()  # found by the change since the last zero alone: grown as slowly as drift does, and may be drift
    DRIFTED = auto()  # uneven drift since the last zero would hide a contact that grows slowly: zero it


_UNKNOWN = Quality.TOO_FEW_ELEMENTS | Quality.NO_BASELINE | Quality.BLIND
_NOTHING = Quality.NO_CONTACT | Quality.WRONG_SIGN | _UNKNOWN
DOUBT = (
    Quality.POOR_FIT | Quality.OUT_OF_ARC | Quality.OVERLOAD | Quality.NOT_CONVERGED | Quality.IMPRECISE
    | Quality.SUSPECT | Quality.WRONG_SIGN | Quality.SLOW
)  # fmt: skip


class State(Enum):
    """Say what is known of a touch; the flags of `Quality` say why."""

    BLIND = "blind"  # whether anything touches is not known
    UNTOUCHED = "untouched"
    TOUCHED = "touched"
    DOUBTFUL = "doubtful"  # something is there, but not one touch that presses and is told well


def state_of(quality: Quality) -> State:
    """Return the state that the flags say."""
    if quality & _UNKNOWN:
        return State.BLIND
    if quality & Quality.NO_CONTACT:
        return State.UNTOUCHED
    return State.DOUBTFUL if quality & DOUBT else State.TOUCHED


@dataclass(frozen=True, slots=True)
class Load:
    """A measured load P [N/m] and its standard deviation [N/m]; zero deviation means exact."""

    value: float
    deviation: float


@dataclass(frozen=True, slots=True)
class ShapeEstimate:
    """Hold what one frame says about the touch; immutable.  All numbers are nan when nothing was estimated.

    Args:
        angle_rad: place t_c.
        load_n_per_m: P, compression positive.
        equivalent_radius_m: R, 1/R = 1/rb + 1/rc.
        equivalent_curvature_per_m: 1/R, which behaves for flats (1/rb) and is infinite for an edge.
        radius_m: rc, infinite for a flat or hollow indenter.
        width_rad: theta_w = 2a.
        residual: root mean square of strain less model, over the usable elements.
        misfit: chi square per degree of freedom, about 1 when the model fits.
        covariance: of (angle [rad], load [N/m], R [m]), rows in this order.
        quality: flags.
        steps: steps of the search.
    """

    angle_rad: float
    load_n_per_m: float
    equivalent_radius_m: float
    equivalent_curvature_per_m: float
    radius_m: float
    width_rad: float
    residual: float
    misfit: float
    covariance: tuple[tuple[float, float, float], ...]
    quality: Quality
    steps: int

    @property
    def deviations(self) -> tuple[float, float, float]:
        """Return the standard deviations of angle [rad], load [N/m] and R [m]."""
        c = self.covariance
        return math.sqrt(c[0][0]), math.sqrt(c[1][1]), math.sqrt(c[2][2])

    @property
    def usable(self) -> bool:
        """Return whether anything was estimated."""
        return not self.quality & _NOTHING

    @property
    def state(self) -> State:
        """Return blind, untouched, touched or doubtful."""
        return state_of(self.quality)

    @property
    def doubtful(self) -> bool:
        """Return whether a flag says not to rely on the numbers; an edge or a flat is no doubt."""
        return bool(self.quality & (_NOTHING | DOUBT))


BLANK = ((math.nan,) * 3,) * 3


def nothing(quality: Quality) -> ShapeEstimate:
    """Return an estimate that says why there is none."""
    n = math.nan
    return ShapeEstimate(n, n, n, n, n, n, n, n, BLANK, quality, 0)
