"""Read tables as instruments and spreadsheets write them: CSV of any dialect, NPZ, MAT, and recordings of one node.

A CSV may part its columns by comma, semicolon, tab or blanks, write 1,5 for 1.5, carry lines of remarks before its
head, a unit in each name (``pos [deg]``, ``pos (deg)``, ``pos/deg``, ``pos_deg``) or a line of units below the head,
and columns of text, which are left out. Columns without a head, or with one that several have, are ``column 1``,
``column 2`` and so on. A matrix as MATLAB prints it (``[0 1.5; 1 2.5];``,
a row a line) may stand for the rows. A
time of day, with or without a date before it (``2024-02-01 12:30:00.125``), is read as seconds since midnight.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.documents import read_bytes
from sioms.lab.arrays import MOST_BYTES, UnreadableError, read_npz
from sioms.lab.mat import read_mat
from sioms.protocol.flags import NodeClass
from sioms.reconcile.errors import BadInputError
from sioms.recording.tables import of_one_node

Array = NDArray[np.float64]
SUFFIXES = (".csv", ".npz", ".mat", ".txt", ".mcap")
#: The pound-force in N, exactly (the pound times standard gravity).
LBF = 0.45359237 * 9.80665
#: Factors to SI, by what they measure.
UNITS = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "length": {
        "m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9,
        "in": 0.0254, "ft": 0.3048, "mil": 2.54e-5,
    },
    "angle": {
        "rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180.0, "turn": 2.0 * np.pi,
        "arcmin": np.pi / 10800.0, "arcsec": np.pi / 648000.0,
    },
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3, "lbf": LBF, "kip": 1e3 * LBF, "ozf": LBF / 16.0, "kgf": 9.80665},
    "torque": {
        "N m": 1.0, "mN m": 1e-3, "kN m": 1e3, "N mm": 1e-3, "N cm": 1e-2,
        "lbf ft": 0.3048 * LBF, "lbf in": 0.0254 * LBF, "ozf in": 0.0254 * LBF / 16.0, "kgf cm": 0.0980665,
    },
    "electric": {"V": 1.0, "mV": 1e-3, "A": 1.0, "mA": 1e-3, "%": 1.0},
    "number": {"1": 1.0},
    "speed": dict.fromkeys(("m/s", "mm/s", "rad/s", "deg/s", "rpm", "1/min", "in/s", "ft/s", "rps"), 1.0),
}  # fmt: skip
#: Other spellings of the same units.
SPELLINGS = {
    "°": "deg",
    "degree": "deg",
    "degrees": "deg",
    "rev": "turn",
    "revs": "turn",
    "turns": "turn",
    "sec": "s",
    "msec": "ms",
    "µs": "us",
    "μs": "us",
    "µm": "um",
    "μm": "um",
    "Nm": "N m",
    "N*m": "N m",
    "N·m": "N m",
    "Nmm": "N mm",
    "Ncm": "N cm",
    "mNm": "mN m",
    "kNm": "kN m",
    "counts": "count",
    "cts": "count",
    "inc": "count",
    "ticks": "count",
    "U/min": "rpm",
    "inch": "in",
    "inches": "in",
    '"': "in",
    "feet": "ft",
    "thou": "mil",
    "lb": "lbf",
    "lbs": "lbf",
    "kips": "kip",
    "oz": "ozf",
    "kp": "kgf",
    "lb ft": "lbf ft",
    "lb-ft": "lbf ft",
    "lbf-ft": "lbf ft",
    "ft-lb": "lbf ft",
    "ft lb": "lbf ft",
    "ft-lbf": "lbf ft",
    "lb in": "lbf in",
    "lb-in": "lbf in",
    "lbf-in": "lbf in",
    "in-lb": "lbf in",
    "in lb": "lbf in",
    "oz-in": "ozf in",
    "oz in": "ozf in",
    "ozf-in": "ozf in",
    "kgf-cm": "kgf cm",
    "kg-cm": "kgf cm",
    "percent": "%",
    "pct": "%",
    "-": "1",
    "": "1",
}
#: Kinds of arrays that are columns.
NUMBERS = "fiub"
#: Columns of a matrix at most.
WIDEST = 64
#: Lines that may stand before the head.
REMARKS = 60
_IN_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]$")
_AFTER_SLASH = re.compile(r"^(.*?)\s*/\s*([^/]+)$")
_CLOCK = re.compile(r"^(?:\S+[ T])?(\d{1,2}):(\d\d):(\d\d(?:\.\d+)?)(?:Z|[-+]\d\d:?\d\d)?$")
_MATRIX = re.compile(r"^\s*(?:\w+\s*=\s*)?\[\s*(?:[-+.\d]|$)")
_BLANKS = re.compile(r"\s{2,}|\t")
#: A number with a decimal point, and one with a decimal comma, as whole cells of a line that no comma parts.
_POINT = re.compile(r"(?:^|[;\s])[-+]?\d+\.\d+(?:[eE][-+]?\d+)?(?=$|[;\s])")
_COMMA = re.compile(r"(?:^|[;\s])[-+]?\d+,\d+(?:[eE][-+]?\d+)?(?=$|[;\s])")
_TRUTHS = {"true": 1.0, "false": 0.0}
_AFTER_BAR = re.compile(r"^(.+)_([^_\W]+)$")


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of one file, shape (n,) each, by their heads; the units that the heads state, if any; and the first cells
    of columns of text.
    """

    columns: dict[str, Array]
    units: dict[str, str]
    texts: Mapping[str, str] = field(default_factory=dict)

    def find(self, name: str) -> str | None:
        """Return the head of the column that is meant: as given, or the only one that is so but for its unit."""
        if name in self.columns:
            return name
        alike = [head for head in self.columns if named(head)[0] == name]
        return alike[0] if len(alike) == 1 else None


def unit_of(text: str) -> str | None:
    """Return the usual spelling of a unit; None where it is not known."""
    text = text.strip()
    text = SPELLINGS.get(text, text)
    return text if text == "count" or any(text in group for group in UNITS.values()) else None


def measures(unit: str) -> str:
    """Say what a known unit measures: time, length, angle, force ..."""
    return next((kind for kind, group in UNITS.items() if unit in group), "count")


def named(head: str) -> tuple[str, str | None]:
    """Part the head of a column into its name and the unit that it states."""
    head = head.strip().strip('"').strip()
    for pattern in (_IN_BRACKETS, _AFTER_SLASH):
        if (m := pattern.match(head)) and m[1] and (unit := unit_of(m[2])):
            return m[1].strip(), unit
    m = _AFTER_BAR.match(head)
    return head, unit_of(m[2]) if m else None


def load_table(path: Path) -> Table:
    """Read the columns of one file.

    Raises:
        BadInputError: there is no such file, or it is no table.
    """
    if not path.exists():
        raise BadInputError(f"read {path}: no such file")
    if path.suffix in (".npz", ".mat"):
        try:
            raw = read_npz(path) if path.suffix == ".npz" else read_mat(path)
        except UnreadableError as error:
            raise BadInputError(str(error)) from None
        return _table(_flat({k: np.asarray(v) for k, v in raw.items()}))
    if path.suffix == ".mcap":
        try:
            _, columns = of_one_node(path, NodeClass.AXIS)
        except (OSError, ValueError) as error:
            raise BadInputError(
                error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            ) from None
        return _table({head: np.asarray(values, dtype=np.float64) for head, values in columns.items()})
    return _text(path)


def _flat(arrays: dict[str, NDArray[Any]]) -> dict[str, Array]:
    """Return arrays of numbers as columns; those of a matrix as ``data(:,3)``, or ``data(3,:)`` where it lies down."""
    out: dict[str, Array] = {}
    for name, a in arrays.items():
        if a.dtype.kind not in NUMBERS:
            continue
        if a.ndim == 1:
            out[name] = np.asarray(a, dtype=np.float64)
        elif a.ndim == 2 and min(a.shape) <= WIDEST:
            upright = a.shape[0] >= a.shape[1]
            for i, column in enumerate(a.T if upright else a, start=1):
                head = f"{name}(:,{i})" if upright else f"{name}({i},:)"
                out[head] = np.ascontiguousarray(column, dtype=np.float64)
    return out


def load_columns(path: Path) -> dict[str, Array]:
    """Read the columns of one file, without their units."""
    return load_table(path).columns


def _table(columns: dict[str, Array]) -> Table:
    return Table(columns, {head: unit for head in columns if (unit := named(head)[1]) is not None})


def _text(path: Path) -> Table:
    try:
        raw = read_bytes(path, MOST_BYTES)
    except ValueError as error:
        raise BadInputError(f"read {path}: {error}") from None
    lines = [line for line in _unbracketed(_decoded(raw).splitlines()) if line.strip(" \t,;")]
    first = next((i for i in range(min(len(lines), REMARKS)) if _begins(lines[i : i + 3])), None)
    if first is None:
        raise BadInputError(
            f"read {path}: no numbers in the first {REMARKS} lines; needs one head line of names and numbers below"
            f"{_no_number(lines)}"
        )
    texts = _texts(lines[first])
    rows = _numbers(lines[first:], texts)
    if rows is None:
        bad = next(
            i
            for i in range(first, len(lines))
            if _numbers([lines[i]], texts) is None or _numbers([lines[first], lines[i]], texts) is None
        )
        raise BadInputError(
            f"read {path}: line {bad + 1} is no row of numbers like line {first + 1}: {lines[bad][:60]!r}"
        )
    if (mixed := _mixed(lines[first:])) is not None:
        raise BadInputError(
            f"read {path}: it writes both {mixed[0]!r} and {mixed[1]!r}: is the point or the comma the decimal one? "
            "Needs numbers without signs of thousands"
        )
    head, units = _head(lines[:first], rows.shape[1]) if first else (_numbered(rows.shape[1]), [])
    if any(_numbers([cell]) is not None for cell in head):
        raise BadInputError(
            f"read {path}: line {first} is neither names nor {rows.shape[1]} numbers: {lines[first - 1][:60]!r}"
        )
    if not head:
        raise BadInputError(f"read {path}: no line of {rows.shape[1]} names over {rows.shape[1]} columns")
    often = Counter(head)
    head = [n if often[n] == 1 else other for n, other in zip(head, _numbered(len(head)), strict=True)]
    table = _table({n: np.ascontiguousarray(rows[:, i]) for i, n in enumerate(head) if i not in texts})
    cells = _cells(lines[first], _sign(lines[first]))
    return Table(
        table.columns,
        {**table.units, **{n: u for n, u in zip(head, units, strict=False) if u}},
        {head[i]: cells[i] for i in sorted(texts)},
    )


def _decoded(raw: bytes) -> str:
    """Return a text as spreadsheets of several systems write it."""
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return raw.decode("utf-16", "replace")
    for start, name in ((1, "utf-16-le"), (0, "utf-16-be")):
        every_second = raw[start:200:2]
        if len(every_second) > 1 and not any(every_second):
            return raw.decode(name, "replace")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def _begins(lines: Sequence[str]) -> bool:
    """Say whether rows begin: all of some lines numbers but for the same columns of text, of which two are none."""
    texts = _texts(lines[0])
    cells = len(_cells(lines[0], _sign(lines[0])))
    if texts and (cells - len(texts) < 2 or any(_texts(line) != texts for line in lines)):
        return False
    return _numbers(lines[:1], texts) is not None and _numbers(lines, texts) is not None


def _texts(line: str) -> frozenset[int]:
    """Return which cells of a line are no numbers."""
    sign = _sign(line)
    cells = _cells(line.replace(",", ".") if sign != "," else line, sign)
    return frozenset(i for i, cell in enumerate(cells) if not _is_number(cell))


def _is_number(cell: str) -> bool:
    try:
        _value(cell)
    except ValueError:
        return False
    return True


def _no_number(lines: Sequence[str]) -> str:
    """Say which cell of the first lines keeps them from being rows of numbers."""
    for line in lines[1:3]:
        cells = _cells(line, _sign(line))
        if bad := [cells[i] for i in sorted(_texts(line)) if i < len(cells)]:
            return f"; {bad[0][:30]!r} in {line[:60]!r} is none"
    return ""


def _mixed(lines: Sequence[str]) -> tuple[str, str] | None:
    """Return a number with a point and one with a comma where both stand for a decimal one, None where they do not."""
    found: list[str] = []
    for pattern in (_POINT, _COMMA):
        match = next((m for line in lines if _sign(line) != "," and (m := pattern.search(line))), None)
        if match is None:
            return None
        found.append(match[0].strip("; \t"))
    return found[0], found[1]


def _unbracketed(lines: Sequence[str]) -> Sequence[str]:
    """Take the brackets and semicolons off a matrix that begins in one of the first lines, as MATLAB prints it."""
    begin = next((i for i, line in enumerate(lines[:REMARKS]) if _MATRIX.match(line)), None)
    if begin is None:
        return lines
    first = lines[begin].partition("[")[2]
    return [*lines[:begin], *(line.strip().strip("[]; ") for line in (first, *lines[begin + 1 :]))]


def _numbered(count: int) -> list[str]:
    """Return the names of columns that have none."""
    return [f"column {i}" for i in range(1, count + 1)]


def _cells(line: str, sign: str | None) -> list[str]:
    parted = next(csv.reader([line.strip()], delimiter=sign)) if sign and '"' in line else line.strip().split(sign)
    cells = [c.strip().strip('"').strip() for c in parted]
    return cells[:-1] if len(cells) > 1 and not cells[-1] else cells


def _sign(line: str) -> str | None:
    """What parts the columns; None: blanks."""
    return next((s for s in ";\t," if s in line), None)


def _numbers(lines: Sequence[str], texts: Collection[int] = ()) -> Array | None:
    """Read rows of numbers, all alike; None where they are none. A comma is a decimal point where it does not part the
    columns.

    Args:
        texts: columns of text, nan in all rows.
    """
    sign = _sign(lines[0])
    text = [line.replace(",", ".") for line in lines] if sign != "," else lines
    try:
        rows = [[np.nan if i in texts else _value(c) for i, c in enumerate(_cells(line, sign))] for line in text]
    except ValueError:
        return None
    return np.array(rows) if len({len(r) for r in rows}) == 1 else None


def _value(cell: str) -> float:
    """Read a number or a time of day; nan for an empty cell."""
    try:
        return float(cell) if cell else np.nan
    except ValueError:
        if cell.lower() in _TRUTHS:
            return _TRUTHS[cell.lower()]
        if (m := _CLOCK.match(cell)) is None:
            raise
        return 3600.0 * int(m[1]) + 60.0 * int(m[2]) + float(m[3])


def _names(line: str, count: int) -> list[str]:
    """Part a line into so many names, with blanks in them where two blanks part the columns; none where it is not."""
    sign = _sign(line)
    cells = _cells(line, sign)
    if len(cells) != count and sign in (None, "\t"):
        cells = [c.strip() for c in _BLANKS.split(line.strip())]
    return cells if len(cells) == count else []


def _head(above: Sequence[str], count: int) -> tuple[list[str], list[str | None]]:
    """Find the names, and a line of units below them, in the lines above the numbers."""
    wide = [c for line in above if (c := _names(line.lstrip("#%"), count))]
    if not wide:
        return [], []
    units = [unit_of(re.sub(r"[\[\]()]", "", c)) for c in wide[-1]]
    if len(wide) > 1 and all(u is not None for u in units):
        return wide[-2], [None if u == "1" else u for u in units]
    return wide[-1], []
