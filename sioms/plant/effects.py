"""Effects a plant may have beyond its nominal model, read from a TOML text.

A table per axis (its name, or ``"*"`` for all), a table in it per effect::

    [xaxis]
    coulomb = { level = 2.5, level_minus = 3.1 }
    cogging = { amplitude = 0.8, pitch = 0.032 }
    delay = { delay_s = 0.002 }

    ["*"]
    thermal_gain = { loss = 0.1, tau_s = 20.0, rated_force = 30.0 }

An axis' own table goes before ``"*"``. Several of one kind act together when given as a list of tables
(``cogging = [{...}, {...}]``). This module knows names, parameters and bounds; what the effects do is
in ``forces``, ``drive``, ``transmission`` and ``encoder``.

Units: "force" is N or N m, "position" m or rad, as the axis has it.
"""

import difflib
import math
from collections.abc import Mapping, Sequence
from enum import Enum

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from sioms.documents import toml_of

Array = NDArray[np.float64]


class Place(Enum):
    """Where in the plant an effect acts."""

    PARAMETER = "parameter of the nominal model"
    DRIVE = "command to force of the drive"
    MOTOR = "force on the motor"
    LOAD = "force on the load"
    RESISTANCE = "resistance to motion"
    VARIATION = "factor on dry friction"
    TRANSMISSION = "between motor and load"
    ENCODER = "position to reading"


class Parameter(Struct, frozen=True):
    """One number of an effect.

    Args:
        unit: its SI unit in words of the module.
        low, high: accepted range, inclusive.
        default: value when not given; a str takes over another parameter, None demands the number.
        neutral: value with which the effect does nothing, for axes that do not have it.
    """

    unit: str
    low: float = -math.inf
    high: float = math.inf
    default: float | str | None = None
    neutral: float = 0.0


class Kind(Struct, frozen=True):
    """One kind of effect: where it acts, what it does, its parameters."""

    place: Place
    text: str
    parameters: Mapping[str, Parameter]


class Effect(Struct, frozen=True):
    """One kind of effect on a bank of n axes.

    Args:
        name: key of the catalogue.
        active: which axes have it, shape (n,).
        values: parameter values, shape (n,) each, neutral where not active.
    """

    name: str
    active: NDArray[np.bool_]
    values: Mapping[str, Array]

    @property
    def place(self) -> Place:
        """Where it acts."""
        return CATALOGUE[self.name].place


class EffectsError(ValueError):
    """The table of effects is wrong; the message has a line per mistake."""


_SIZE = Parameter("force", low=0.0)
_PITCH = Parameter("position", low=1e-12, neutral=1.0)
_PHASE = Parameter("rad", default=0.0)
_SECONDS = Parameter("s", low=1e-9, neutral=1.0)
_FRACTION = Parameter("1", low=0.02, high=0.98, neutral=0.5)

CATALOGUE: Mapping[str, Kind] = {
    "viscous": Kind(
        Place.PARAMETER,
        "further viscous friction, may differ by direction",
        {
            "coefficient": Parameter("force s/position", low=0.0),
            "coefficient_minus": Parameter("force s/position", low=0.0, default="coefficient"),
        },
    ),
    "coulomb": Kind(
        Place.PARAMETER,
        "further dry friction, may differ by direction",
        {"level": _SIZE, "level_minus": Parameter("force", low=0.0, default="level")},
    ),
    "offset": Kind(Place.PARAMETER, "constant force", {"force": Parameter("force")}),
    "payload": Kind(Place.PARAMETER, "further mass or inertia", {"mass": Parameter("mass", low=0.0)}),
    "delay": Kind(Place.DRIVE, "transport delay of the command", {"delay_s": Parameter("s", low=0.0, high=1.0)}),
    "lag": Kind(Place.DRIVE, "first-order lag of the drive", {"tau_s": Parameter("s", low=0.0)}),
    "slew_limit": Kind(
        Place.DRIVE,
        "the force of the drive changes no faster than this",
        {"rate": Parameter("force/s", low=1e-12, neutral=math.inf)},
    ),
    "saturation": Kind(
        Place.DRIVE,
        "the drive gives no more than this",
        {
            "limit": Parameter("force", low=0.0, neutral=math.inf),
            "limit_minus": Parameter("force", low=0.0, default="limit", neutral=math.inf),
        },
    ),
    "thermal_gain": Kind(
        Place.DRIVE,
        "force constant falls as the motor warms up: 1/(1 + loss T), tau dT/dt = (F/rated)^2 - T",
        {
            "loss": Parameter("1", low=-0.9),
            "tau_s": _SECONDS,
            "rated_force": Parameter("force", low=1e-12, neutral=1.0),
            "start": Parameter("1", low=0.0, default=0.0),
        },
    ),
    "torque_ripple": Kind(
        Place.MOTOR,
        "force constant varies with position: 1 + depth sin(2 pi x/pitch + phase)",
        {"depth": Parameter("1", low=-1.0, high=1.0), "pitch": _PITCH, "phase": _PHASE},
    ),
    "cogging": Kind(
        Place.MOTOR,
        "amplitude sin(2 pi x/pitch + phase)",
        {"amplitude": Parameter("force"), "pitch": _PITCH, "phase": _PHASE},
    ),
    "gravity": Kind(
        Place.LOAD,
        "pendulum: -amplitude sin(2 pi x/pitch + phase) at the load; pitch 2 pi rad unless given",
        {
            "amplitude": Parameter("force"),
            "phase": _PHASE,
            "pitch": Parameter("position", low=1e-12, default=math.tau, neutral=1.0),
        },
    ),
    "spring": Kind(
        Place.LOAD,
        "-stiffness (x - rest) - cubic (x - rest)^3 at the load",
        {
            "stiffness": Parameter("force/position", low=0.0),
            "rest": Parameter("position", default=0.0),
            "cubic": Parameter("force/position^3", low=0.0, default=0.0),
        },
    ),
    "stribeck": Kind(
        Place.RESISTANCE,
        "further friction near rest: rise exp(-(v/velocity)^2)",
        {"rise": _SIZE, "velocity": Parameter("position/s", low=1e-12, neutral=1.0)},
    ),
    "quadratic_drag": Kind(
        Place.RESISTANCE, "coefficient v^2", {"coefficient": Parameter("force s^2/position^2", low=0.0)}
    ),
    "load_friction": Kind(
        Place.RESISTANCE,
        "friction that grows with the force of the drive: coefficient |F|",
        {"coefficient": Parameter("1", low=0.0, high=0.95)},
    ),
    "position_friction": Kind(
        Place.RESISTANCE,
        "friction that varies with position: level (1 + depth sin(2 pi x/pitch + phase))",
        {"level": _SIZE, "depth": Parameter("1", low=0.0, high=1.0), "pitch": _PITCH, "phase": _PHASE},
    ),
    "friction_variation": Kind(
        Place.VARIATION,
        "all dry friction varies with position: times 1 + depth sin(2 pi x/pitch + phase)",
        {"depth": Parameter("1", low=0.0, high=1.0), "pitch": _PITCH, "phase": _PHASE},
    ),
    "eddy_brake": Kind(
        Place.RESISTANCE,
        "drag with a maximum at velocity: 2 force s/(1 + s^2), s = |v|/velocity",
        {"force": _SIZE, "velocity": Parameter("position/s", low=1e-12, neutral=1.0)},
    ),
    "presliding": Kind(
        Place.MOTOR,
        "further friction that first yields like a spring (LuGre; Dahl without rise): dz/dt = v - |v| z/(g/stiffness), "
        "g = level + rise exp(-(v/velocity)^2)",
        {
            "level": _SIZE,
            "stiffness": Parameter("force/position", low=1e-12, neutral=1.0),
            "rise": Parameter("force", default=0.0),
            "velocity": Parameter("position/s", low=1e-12, default=1.0, neutral=1.0),
        },
    ),
    "elastic": Kind(
        Place.TRANSMISSION,
        "two masses joined by a spring; load_fraction of the mass is behind it",
        {
            "frequency_hz": Parameter("Hz", low=1e-3, high=2000.0, neutral=1.0),
            "damping": Parameter("1", low=0.0, high=2.0, default=0.02),
            "load_fraction": _FRACTION,
        },
    ),
    "backlash": Kind(
        Place.TRANSMISSION,
        "two masses joined with a gap; load_fraction of the mass is behind it",
        {
            "gap": Parameter("position", low=0.0),
            "load_fraction": _FRACTION,
            "frequency_hz": Parameter("Hz", low=1e-3, high=2000.0, default=150.0, neutral=1.0),
            "damping": Parameter("1", low=0.0, high=2.0, default=0.3),
        },
    ),
    "encoder_scale": Kind(Place.ENCODER, "reading = gain x", {"gain": Parameter("1", low=0.1, high=10.0, neutral=1.0)}),
    "encoder_eccentricity": Kind(
        Place.ENCODER,
        "reading = x + amplitude sin(2 pi x/pitch + phase)",
        {"amplitude": Parameter("position"), "pitch": _PITCH, "phase": _PHASE},
    ),
    "encoder_interpolation": Kind(
        Place.ENCODER,
        "reading = x + amplitude sin(2 pi x/pitch + phase) within the signal period pitch",
        {"amplitude": Parameter("position"), "pitch": _PITCH, "phase": _PHASE},
    ),
    "encoder_quantisation": Kind(
        Place.ENCODER, "steps coarser by a factor", {"factor": Parameter("1", low=1.0, neutral=1.0)}
    ),
}


def parse_effects(text: str, axes: Sequence[str], source: str = "effects") -> tuple[Effect, ...]:
    """Read the effects of a bank from TOML.

    Args:
        text: content of the file.
        axes: names of the axes, in the order of the bank.
        source: name of the file, for messages.

    Raises:
        EffectsError: no TOML, or unknown or wrong entries, all of them at once.
    """
    try:
        table = toml_of(text)
    except ValueError as error:
        raise EffectsError(f"read effects of {source}: {error}; want a TOML table per axis") from error
    return build_effects(table, axes, source)


def build_effects(table: Mapping[str, object], axes: Sequence[str], source: str = "effects") -> tuple[Effect, ...]:
    """Turn tables of effects by axis into effects of the bank.

    Raises:
        EffectsError: unknown axis, effect or parameter, or a number out of its range; all at once.

    Example:
        >>> [effect] = build_effects({"x": {"payload": {"mass": 0.5}}}, ["x", "y"])
        >>> effect.name, effect.values["mass"]
        ('payload', array([0.5, 0. ]))
    """
    mistakes: list[str] = []
    given: dict[tuple[str, int], dict[int, dict[str, float]]] = {}
    for key in sorted(table, key=lambda name: name == "*"):
        where = f"read effects of {source}: axis {key!r}"
        members = range(len(axes)) if key == "*" else [axes.index(key)] if key in axes else []
        if not members:
            mistakes.append(f"{where}: no such axis{_hint(key, axes)}")
            continue
        entry = table[key]
        if not isinstance(entry, Mapping):
            mistakes.append(f"{where}: {entry!r} is not a table; want a table of effects")
            continue
        for name, occurrences in entry.items():
            _collect(given, mistakes, f"{where}: effect {name!r}", name, occurrences, members)
    if mistakes:
        raise EffectsError("\n".join(mistakes))
    order = {name: rank for rank, name in enumerate(CATALOGUE)}
    ordered = sorted(given, key=lambda key: (order[key[0]], key[1]))
    return tuple(_arrays(name, given[name, layer], len(axes)) for name, layer in ordered)


def _collect(
    given: dict[tuple[str, int], dict[int, dict[str, float]]],
    mistakes: list[str],
    where: str,
    name: str,
    occurrences: object,
    members: Sequence[int],
) -> None:
    """Check one effect of one axis (or of all) and enter it where the axis has none yet."""
    if name not in CATALOGUE:
        mistakes.append(f"{where}: no such effect{_hint(name, CATALOGUE)}")
        return
    layers = occurrences if isinstance(occurrences, list) else [occurrences]
    taken = {axis for (kind, _), axes in given.items() if kind == name for axis in axes}
    for layer, numbers in enumerate(layers):
        if not isinstance(numbers, Mapping):
            mistakes.append(f"{where}: {numbers!r} is not a table; want {{ {', '.join(CATALOGUE[name].parameters)} }}")
            continue
        values = _numbers(where, CATALOGUE[name].parameters, numbers, mistakes)
        for axis in members:
            if axis not in taken:
                given.setdefault((name, layer), {})[axis] = values


def _numbers(
    where: str, parameters: Mapping[str, Parameter], numbers: Mapping[str, object], mistakes: list[str]
) -> dict[str, float]:
    """Check the numbers of one effect and fill in the defaults."""
    for key in numbers.keys() - parameters.keys():
        mistakes.append(f"{where}: no parameter {key!r}{_hint(key, parameters)}")
    values: dict[str, float] = {}
    for key, parameter in parameters.items():
        value = numbers.get(key, parameter.default)
        if isinstance(value, str) and key not in numbers:
            value = values.get(value, 0.0)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            missing = "missing" if key not in numbers else f"{value!r} is not a finite number"
            mistakes.append(f"{where}: {key} [{parameter.unit}] {missing}")
        elif not parameter.low <= value <= parameter.high:
            mistakes.append(
                f"{where}: {key} = {value:g} {parameter.unit}; must be {parameter.low:g} to {parameter.high:g}"
            )
        else:
            values[key] = float(value)
    return values


def _arrays(name: str, by_axis: Mapping[int, Mapping[str, float]], n: int) -> Effect:
    """Spread the numbers of single axes over the bank."""
    active = np.zeros(n, dtype=np.bool_)
    active[list(by_axis)] = True
    values = {key: np.full(n, parameter.neutral) for key, parameter in CATALOGUE[name].parameters.items()}
    for axis, numbers in by_axis.items():
        for key, value in numbers.items():
            values[key][axis] = value
    return Effect(name, active, values)


def _hint(word: str, known: Mapping[str, object] | Sequence[str]) -> str:
    """Return a suggestion for a misspelt word, or the list of words."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"; did you mean {close[0]!r}?" if close else f"; known: {', '.join(known)}"
