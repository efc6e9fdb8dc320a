"""Look at a file of somebody's records and draft both descriptions: what each column seems to be, and what is asked.

A column is taken for what its head says if its numbers agree; one without a telling head for what its numbers do beside
the others. What is not certain stands as a question in the draft, which then cannot be used before it is answered.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.heads import WORDS, meaning
from sioms.reconcile.files.table import SUFFIXES, UNITS, Array, Table, load_table, measures, named

#: Two columns say the same from this correlation on; one rises evenly where all but so few of its steps are within this
#: share of the usual one: some rows of a polled log come late.
SAME, EVEN, LATE = 0.98, 0.1, 0.1
#: A column of time steps of the log may vary by so much of one: polled, not sampled.
POLLED = 0.5
#: Rows that tell what a column is.
FEWEST = 8
#: An index mark passes in at most this share of the rows; what changes in fewer than the second is set, not measured.
RARE, SELDOM = 0.1, 0.01
NEEDED = ("position", "force")
#: How the scale of a voltage or a current is found.
ELECTRIC = {
    "V": "Of a motor driven by voltage: k_t/R, and viscous then holds its back-EMF, k_t k_e/R; 1 where neither is "
    "known (inertia and all forces are then in V).",
    "A": "The torque or force constant, gear included; 1 where it is not known (inertia and all forces are then in A).",
}
#: What is not needed, in words.
SPARE = {"velocity": "a speed", "acceleration": "an acceleration"}
#: What may stand for a quantity that is needed.
HINTS = {
    "position": "",
    "force": "; what the drive was told, or where that was not recorded its measured force or current with a scale; "
    "none where nothing drives the axis (driven = false in nominal.toml)",
}


@dataclass(frozen=True, slots=True)
class Guess:
    """What a column seems to be.

    Attributes:
        quantity: of ``columns.toml``, or one of `SPARE`, which is not needed; None where nothing tells.
        why: in words.
        beside: another column that was taken for what the head of this one says.
    """

    head: str
    unit: str | None
    quantity: str | None
    why: str
    beside: str | None = None


@dataclass(frozen=True, slots=True)
class Draft:
    """Both descriptions, and what is to be answered before they can be used."""

    columns: str
    model: str
    questions: tuple[str, ...]


def describe(data: Path) -> Draft:
    """Look at a file, or all of a folder: columns are those of the first, what is largest is that of all.

    Raises:
        BadInputError: there is none, or one of them cannot be read.
    """
    if not data.exists():
        raise BadInputError(f"describe {data}: no such file or folder")
    files = [data] if data.is_file() else sorted(p for p in data.glob("*") if p.suffix in SUFFIXES)
    if not files:
        raise BadInputError(f"describe {data}: no data files; expects one of {', '.join(SUFFIXES)}")
    table, *others = (_of_rows(load_table(f)) for f in files)
    guesses = guessed(table)
    step, said = _step(table, guesses)
    questions = [*said, *_questions(guesses)]
    questions += [f"what is {h!r}? It is of text ({t[:30]!r}); it is left out." for h, t in table.texts.items()]
    for file, other in zip(files[1:], others, strict=True):
        lacks = [g.head for g in guesses if g.quantity is not None and g.head not in other.columns]
        if lacks:
            questions.append(
                f"is {file.name} another kind of record? It has no column {', '.join(map(repr, lacks))}, "
                f"as {files[0].name} has."
            )
    model, asked = _model([table, *others], guesses, step)
    return Draft(_columns(guesses, step), model, (*questions, *asked))


def _of_rows(table: Table) -> Table:
    """Return the columns with as many rows as most have: constants and names may lie beside them."""
    sizes = [len(a) for a in table.columns.values()]
    rows = max(set(sizes), key=lambda n: (n > 1, sizes.count(n), n)) if sizes else 0
    return Table({h: a for h, a in table.columns.items() if len(a) == rows}, table.units, table.texts)


def guessed(table: Table) -> list[Guess]:
    """Say what every column seems to be, each quantity once."""
    out: dict[str, Guess] = {}
    taken: dict[str, str] = {}
    for quantity in WORDS:
        for head in table.columns:
            if head not in out and quantity not in taken and quantity == _by_head(head, table):
                unit = table.units.get(head, named(head)[1])
                out[head] = Guess(head, unit, quantity, "by its head")
                taken[quantity] = head
    if "position" not in taken and (found := _changes_of(table, [h for h in table.columns if h not in out])):
        head, speed = found
        out[head] = Guess(head, table.units.get(head, named(head)[1]), "position", f"{speed!r} goes with its changes")
        taken["position"] = head
    for head, values in table.columns.items():
        says = _by_head(head, table)
        if head not in out and says in taken:
            out[head] = Guess(head, table.units.get(head, named(head)[1]), _again(says), "by its head", taken[says])
        elif head not in out:
            seems, why = _by_numbers(values, table, taken)
            out[head] = Guess(head, table.units.get(head, named(head)[1]), seems, why)
            if seems is not None:
                taken.setdefault(seems, head)
    return [out[head] for head in table.columns]


def _again(quantity: str) -> str | None:
    """Return what a further column of a quantity is: another speed is as little needed as the first."""
    return quantity if quantity in SPARE else None


def _by_head(head: str, table: Table) -> str | None:
    """Return what the head says, where its unit and its numbers do not say otherwise."""
    name, unit = named(head)
    unit = table.units.get(head, unit)
    found = meaning(name)
    kind = measures(unit) if unit is not None else None
    if kind == "speed":
        return "velocity"
    if kind in ("length", "angle") and found not in ("position", "command"):
        return "position" if found is None else None
    if kind in ("force", "torque") and found not in ("force", "force_measured"):
        return "force" if found is None else None
    if kind == "time" and found != "time":
        return None
    if kind == "electric" and found == "velocity":
        found = {"V": "force", "A": "force_measured"}[unit[-1]] if unit and unit != "%" else None  # v [V], not a speed
    if found == "index" and not _fits(found, table.columns[head]):
        found = "position"  # a place along z
    return found if found is not None and _fits(found, table.columns[head]) else None


def _fits(quantity: str, values: Array) -> bool:
    """Say whether a column may be what its head says."""
    if quantity == "time":
        return bool(np.all(np.diff(values[np.isfinite(values)]) >= 0.0))
    return len(np.unique(values)) <= 2 if quantity == "index" else float(np.ptp(values)) > 0.0


def _by_numbers(values: Array, table: Table, taken: Mapping[str, str]) -> tuple[str | None, str]:
    """Return what the numbers of a column look like beside those that are known by now."""
    steps = np.diff(values)
    if len(values) < FEWEST:
        return None, f"{len(values)} rows are too few to tell it by"
    if not np.all(np.isfinite(values)):
        return None, f"{int(np.sum(~np.isfinite(values)))} of its values are no numbers"
    if np.ptp(values) == 0.0:
        return None, f"constant at {values[0]:.6g}"
    usual = float(np.median(steps))
    if "time" not in taken and np.all(steps > 0.0) and np.mean(np.abs(steps - usual) > 1.001 * EVEN * usual) < LATE:
        return "time", "it rises by even steps"
    if "index" not in taken and np.array_equal(np.unique(values), (0.0, 1.0)) and np.mean(values) < RARE:
        return "index", "it is 1 now and then"
    for known in ("position", "force"):
        if known not in taken:
            continue
        other = table.columns[taken[known]]
        if np.array_equal(values, other):
            return None, f"the same as {taken[known]}"
        if known == "position" and abs(_alike(values[1:], np.diff(other))) > SAME:
            return "velocity", f"it goes with the changes of {taken[known]}"
        beside = {"position": "command", "force": "force_measured"}[known]
        if beside not in taken and _alike(values, other) > SAME:
            return beside, f"it goes with {taken[known]}"
    if np.mean(steps != 0.0) < SELDOM:
        return None, "it changes in steps, as what somebody sets"
    if "position" not in taken and np.std(np.diff(values, 3)) < 0.05 * np.std(values):
        return "position", "it changes smoothly"
    return None, "nothing tells what it is"


def _changes_of(table: Table, heads: list[str]) -> tuple[str, str] | None:
    """Return a column and one that goes with its changes, the first with those of no other; None without such."""
    columns = {h: c for h in heads if len(c := table.columns[h]) >= FEWEST and np.all(np.isfinite(c))}
    pairs = [
        (x, v) for x in columns for v in columns if x != v and abs(_alike(columns[v][1:], np.diff(columns[x]))) > SAME
    ]
    speeds = {v for _, v in pairs}
    return next((pair for pair in pairs if pair[0] not in speeds), None)


def _alike(a: Array, b: Array) -> float:
    if np.std(a) == 0.0 or np.std(b) == 0.0:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def _step(table: Table, guesses: list[Guess]) -> tuple[float | None, list[str]]:
    """Return the time between rows in seconds, and what is to be said of it."""
    found = next((g for g in guesses if g.quantity == "time"), None)
    if found is None or len(table.columns[found.head]) < 2:
        return None, ["what is the time between two rows (sample_time_s)? There is no column of time."]
    steps = np.diff(table.columns[found.head])
    typical = float(np.median(steps))
    asked = []
    if found.unit is None:
        asked.append(f"in what unit is the time in {found.head!r} (steps of {typical:.6g})? Taken for seconds.")
    if typical > 0.0 and np.mean(np.abs(steps - typical) > POLLED * typical) > 0.01:
        low, high = np.quantile(steps, (0.05, 0.95))
        asked.append(
            f"are rows missing, or was the log polled? Steps of {found.head!r} go from {low:.4g} to {high:.4g}."
        )
    return typical * UNITS["time"].get(found.unit or "s", 1.0), asked


def _questions(guesses: list[Guess]) -> list[str]:
    got = {g.quantity for g in guesses}
    out = [f"which column is the {q}? It is needed{HINTS[q]}." for q in NEEDED if q not in got]
    for taken in (g for g in guesses if g.quantity is not None and g.quantity not in SPARE):
        others = ", ".join(repr(g.head) for g in guesses if g.beside == taken.head)
        if others:
            out.append(f"which column is the {taken.quantity}, {taken.head!r} or {others}? The first is taken.")
    out += [
        f"what is {g.head!r}? {g.why[0].upper()}{g.why[1:]}; it is left out."
        for g in guesses
        if g.quantity is None and g.beside is None
    ]
    for g in guesses:
        if g.unit is None and g.quantity in ("position", "command", "force", "force_measured"):
            out.append(f"in what unit is {g.head!r}, which seems to be the {g.quantity} ({g.why})?")
        elif g.unit is not None and measures(g.unit) == "electric" and g.unit != "%":
            out.append(f"how many N or N m is one {g.unit} of {g.head!r} (scale)? {ELECTRIC[g.unit[-1]]}")
    return out


def _columns(guesses: list[Guess], step: float | None) -> str:
    lines = [] if step is not None else ["# sample_time_s = ?   # seconds between two rows"]
    lines.append("[columns]")
    for g in guesses:
        head = g.head.replace("\\", "\\\\").replace('"', '\\"')
        if g.quantity is None:
            why = g.why if g.beside is None else f"{g.beside} was taken for what its head says"
            lines.append(f'# QUANTITY = {{ name = "{head}" }}   # left out: {why}')
        elif g.quantity in SPARE:
            lines.append(f'# not needed: "{head}", {SPARE[g.quantity]} ({g.why})')
        else:
            unit = f', unit = "{g.unit}"' if g.unit else ', unit = "?"' if g.quantity not in ("time", "index") else ""
            scale = ", scale = 1.0" if g.unit and measures(g.unit) == "electric" and g.unit != "%" else ""
            lines.append(f'{g.quantity} = {{ name = "{head}"{unit}{scale} }}   # {g.why}')
    return "\n".join(lines) + "\n"


def _model(tables: list[Table], guesses: list[Guess], step: float | None) -> tuple[str, tuple[str, ...]]:
    """Draft the model: what the records show, the rest as questions."""
    by = {g.quantity: g for g in guesses if g.quantity is not None}
    kinds = {measures(g.unit) for q in ("position", "force") if (g := by.get(q)) is not None and g.unit}
    kind = "rotary" if kinds & {"angle", "torque"} else "linear" if kinds & {"length", "force"} else None
    lines, asked = ["[axis]"], []

    def line(key: str, value: object, text: str) -> None:
        lines.append(f"{key} = {value}   # {text}" if value is not None else f"# {key} = ?   # {text}")
        if value is None:
            asked.append(f"{key}: {text}")

    line("kind", f'"{kind}"' if kind else None, "rotary or linear, by the units" if kind else "rotary or linear?")
    line("sample_time_s", f"{step:.9g}" if step else None, "time between two rows")
    line(
        "inertia",
        None,
        "kg or kg m^2, of the data sheet; none, but imposed = true, of a rig that another machine moves",
    )
    line("viscous", "0.0", "N s/m or N m s/rad; 0 where it is not known: it is then named")
    line("pitch", None, "m or rad: lead of the screw or a turn; the period of what is periodic")
    force, place = by.get("force"), by.get("position")
    top = _largest(_si(t, force) for t in tables) if force is not None else None
    line("rated_force", f"{top:.4g}" if top else None, "continuous force; here the largest in the records")
    speed = _largest(_speed(t, place, step) for t in tables) if place is not None and step else None
    line("max_speed", f"{speed:.4g}" if speed else None, "m/s or rad/s; here the largest in the records")
    if place is not None and place.unit == "count":
        line("resolution", None, "m or rad in a count")
    return "\n".join(lines) + "\n", tuple(asked)


def _factor(unit: str | None) -> float | None:
    """Return what one of a unit is in SI; None where that is not known by itself."""
    if unit is None or measures(unit) not in ("length", "angle", "force", "torque"):
        return None
    return UNITS[measures(unit)][unit]


def _largest(found: Iterable[float | None]) -> float | None:
    """Return the largest of those that are known."""
    return max((x for x in found if x is not None), default=None)


def _si(table: Table, g: Guess) -> float | None:
    factor, x = _factor(g.unit), table.columns.get(g.head)
    return None if factor is None or x is None else float(np.nanmax(np.abs(x))) * factor


def _speed(table: Table, g: Guess, step: float) -> float | None:
    factor, n = _factor(g.unit), 5
    x = table.columns.get(g.head)
    if factor is None or x is None or len(x) <= n:
        return None
    return float(np.nanmax(np.abs(x[n:] - x[:-n]))) * factor / (n * step)
