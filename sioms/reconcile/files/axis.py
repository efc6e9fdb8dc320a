"""Read what people have: column files with a short TOML, the layout with ``nominal.json``, model files.

Column description (``columns.toml`` beside the data, or ``--columns``)::

    sample_time_s = 0.001            # or a time column
    loop_time_s = 0.000125           # optional: period of the loop that makes the force, where the log is slower
    files = ["run1.csv", "run2.npz"] # optional; else every data file of the folder, by name
    continuous = true                # heat carries over from file to file
    final = ["run9.csv"]             # optional: whole records that only the final statement sees
    [columns]
    time           = { name = "t",    unit = "s" }
    position       = { name = "qm",   unit = "m" }       # m mm um rad deg turn count ...
    command        = { name = "qg" }                     # unit as the head of the column states it: "qg [mm]"
    force          = { name = "vir",  unit = "V", scale = 35.15 }  # N mN kN, N m, mN m ...; value * scale
    force_measured = { name = "cur",  unit = "N" }
    index          = { name = "idx" }
    feedforward    = { name = "ff",   unit = "N" }       # the part of force that is no feedback, a test signal for
    instance external       = { name = "push", unit = "N" }       # known force on the axis beside the drive's

Files whose heads are these very names, each with its unit (``position [m]``), need no description; ``devin --record``
writes such. A column that the data do not have, or a key that nobody reads, is an error; a file may be without the last
two when another has them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.documents import json_of
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.contents import contents
from sioms.reconcile.files.describe import describe
from sioms.reconcile.files.table import SUFFIXES, UNITS, load_table, measures, named, unit_of
from sioms.reconcile.given import columns_in, number, only, parsed, table_in, truth, words
from sioms.reconcile.model import AxisModel
from sioms.reconcile.model_file import model_from
from sioms.reconcile.records import Record, Session

Array = NDArray[np.float64]
QUANTITIES = ("time", "position", "command", "force", "force_measured", "index", "feedforward", "external")
#: Those which some files of a session may be without: there was none.
SOMETIMES = ("feedforward", "external")
#: Keys of ``nominal.json`` by those of a model file.
LAYOUT_AXIS = {
    "name": "scenario",
    "kind": "kind",
    "sample_time_s": "sample_time",
    "inertia": "inertia",
    "viscous": "viscous",
    "resolution": "encoder_resolution",
    "pitch": "index_pitch",
    "max_speed": "position_max_speed",
    "start_position": "start_position",
}
LAYOUT_CONTROLLER = {
    **{key: key for key in ("k", "kz", "kp", "kb")},
    "offset": "tau_o",
    "limit": "tau_m",
    "velocity_filter_hz": "vel_filter_hz",
}
#: What each quantity may be measured in, on a rotary and on a linear axis.
ROTARY = {
    "time": "time",
    "position": "angle",
    "command": "angle",
    "force": "torque",
    "force_measured": "torque",
    "index": "number",
    "feedforward": "torque",
    "external": "torque",
}
LINEAR = {**ROTARY, "position": "length", "command": "length"} | dict.fromkeys(
    ("force", "force_measured", "feedforward", "external"), "force"
)


def read_data(data: Path, model: AxisModel, columns: Path | None = None) -> Session:
    """Read all records of one axis into SI units.

    Args:
        data: a CSV, NPZ or MAT file, a folder of such files, or a folder of the layout with ``nominal.json``.
        model: nominal model: says whether positions are m or rad, and what a count is worth.
        columns: column description; by default ``columns.toml`` beside the data, which files whose heads say name and
            unit (``position [m]``) do without.

    Returns:
        The records in order, arrays of shape (n,) each.

    Raises:
        BadInputError: something is missing or not understood; if there is no description, the text holds a draft.
    """
    if not data.exists():
        raise BadInputError(f"read {data}: no such file or folder")
    folder = data if data.is_dir() else data.parent
    description = columns or folder / "columns.toml"
    if columns is None and data.is_dir() and list(data.glob("rec_*.npz")) and not description.exists():
        return read_layout(data, model)
    if not description.exists():
        files = _files(data)
        if not files:
            raise BadInputError(f"read {data}: no data files; expects one of {', '.join(SUFFIXES)}")
        if columns is None and (plain := _plain(files)) is not None:
            return Session(tuple(_record(f, plain, model) for f in files), True, (), None)
        raise BadInputError(f"read {data}: no column description (or give --columns): {_draft(files, description)}")
    where = f"read {description}"
    table = parsed(contents(description, where), where)
    only(table, ("sample_time_s", "loop_time_s", "files", "continuous", "final", "columns"), where)
    columns_of = columns_in(table, "columns", QUANTITIES, where)
    place = columns_of.get("position", {}).get("name")
    if same := [q for q, spec in columns_of.items() if q != "position" and spec["name"] == place]:
        raise BadInputError(f"{where}: {place!r} is said to be the position and the {same[0]}; which is it?")
    given = number(table, "sample_time_s", where, model.sample_time_s)
    if not 0.98 < given / model.sample_time_s < 1.02:
        raise BadInputError(
            f"read {description}: sample_time_s is {given:g}, the model says {model.sample_time_s:g}; needs the same"
        )
    loop = number(table, "loop_time_s", where, None) if "loop_time_s" in table else None
    if loop is not None and not 0.0 < loop <= 1.02 * model.sample_time_s:
        raise BadInputError(
            f"{where}: loop_time_s is {loop:g}; needs the period of the loop that makes the force, more than 0 and at "
            f"most the {model.sample_time_s:g} between two rows"
        )
    continuous = truth(table, "continuous", where, True)
    last = [folder / n for n in words(table, "final", where, "names of files") or ()]
    chosen = words(table, "files", where, "names of files")
    files = [f for f in _files(data) if f not in last] if chosen is None else [folder / n for n in chosen]
    if not files:
        raise BadInputError(f"read {data}: no data files; expects one of {', '.join(SUFFIXES)}")
    records, final = (tuple(_record(f, columns_of, model) for f in some) for some in (files, last))
    for quantity in SOMETIMES:
        if quantity in columns_of and all(getattr(r, quantity) is None for r in records + final):
            raise BadInputError(f"read {data}: no file has a column {columns_of[quantity]['name']!r} for {quantity}")
    return Session(records, continuous, final, loop)


def _files(data: Path) -> list[Path]:
    return [data] if data.is_file() else sorted(p for p in data.iterdir() if p.suffix in SUFFIXES)


def _record(path: Path, columns: Mapping[str, Any], model: AxisModel) -> Record:
    table = load_table(path)
    _check_needed(path, columns, model)
    found: dict[str, Array] = {}
    for quantity, spec in columns.items():
        head = table.find(str(spec.get("name")))
        if head is None and quantity in SOMETIMES:
            continue
        text = next((h for h in table.texts if spec.get("name") in (h, named(h)[0])), None)
        if head is None and text is not None:
            raise BadInputError(
                f"read {path.name}: column {text!r} for {quantity} is of text, it begins with "
                f"{table.texts[text][:30]!r}; needs numbers, or a time of day as 12:30:00.125"
            )
        if head is None:
            raise BadInputError(
                f"read {path.name}: no column {spec.get('name')!r} for {quantity}; has "
                f"{', '.join(sorted(table.columns))}"
            )
        found[quantity] = _convert(quantity, table.columns[head], spec, table.units.get(head), model)
    index = found.get("index")
    return Record(
        path.stem,
        found["position"],
        found["force"] if model.driven else np.zeros_like(found["position"]),
        found.get("command"),
        found.get("force_measured"),
        None if index is None else index > 0.5,
        found.get("time"),
        feedforward=found.get("feedforward"),
        external=found.get("external"),
    )


def _check_needed(path: Path, columns: Mapping[str, Any], model: AxisModel) -> None:
    """Check that what every record must hold is described, and no force where nothing drives the axis."""
    where = f"read {path.name}"
    if "position" not in columns:
        raise BadInputError(f"{where}: the column description names no position; it is needed")
    if model.driven and "force" not in columns:
        raise BadInputError(
            f"{where}: the column description names no force; it is needed, unless nothing drives the axis "
            "(driven = false in [axis] of the model)"
        )
    if not model.driven and (other := {"force", "force_measured", "feedforward"} & set(columns)):
        raise BadInputError(
            f"{where}: the column description names {', '.join(sorted(other))}, the model says driven = false; "
            "a force on an axis without a drive is external"
        )


def _convert(quantity: str, raw: Array, spec: Mapping[str, Any], stated: str | None, model: AxisModel) -> Array:
    """Bring a column to SI; its unit is what the description says, else what the head of the column states."""
    where = f"read column {quantity}"
    unit = unit_of(str(spec.get("unit", stated or "1")))
    if unit is None:
        known = ", ".join(["count", *(u for kind, group in UNITS.items() if kind != "speed" for u in group)])
        raise BadInputError(f"{where}: unit {spec['unit']!r} is not known; known are {known}")
    if stated not in (None, unit) and "scale" not in spec and unit != "1":
        raise BadInputError(
            f"{where}: the description says {unit}, the head of the column {spec['name']!r} {stated}; which is it?"
        )
    kind, right = measures(unit), (ROTARY if model.rotary else LINEAR)[quantity]
    if unit == "%" and "scale" not in spec and right in ("force", "torque"):
        return np.asarray(raw * (model.rated_force / 100.0), dtype=np.float64)  # percent of rated, as drives say it
    if kind not in (right, "number", "count") and "scale" not in spec:
        hint = (
            "give scale = ..., what one unit of it is in SI units"
            if kind == "electric"
            else f"needs one of {', '.join(UNITS[right])}"
        )
        raise BadInputError(
            f"{where}: {unit} is a unit of {kind}, the {quantity} of a {'rotary' if model.rotary else 'linear'} axis "
            f"is {'an' if right == 'angle' else 'a'} {right}; {hint}"
        )
    scale, offset = (float(spec.get(key, instead)) for key, instead in (("scale", 1.0), ("offset", 0.0)))
    factor = UNITS[kind][unit] if kind != "count" else _per_count(where, spec, scale, model)
    return np.asarray((raw * scale + offset) * factor, dtype=np.float64)


def _per_count(where: str, spec: Mapping[str, Any], scale: float, model: AxisModel) -> float:
    """Return what a count that has been scaled is worth; 1 where the scale is the size of a count itself."""
    itself = "scale" in spec and (model.resolution <= 0.0 or 0.99 < abs(scale) / model.resolution < 1.01)
    if model.resolution <= 0.0 and not itself:
        raise BadInputError(
            f"{where}: it is in counts, and the model states no resolution; give resolution = ... in [axis]"
        )
    return 1.0 if itself else model.resolution


def _plain(files: Sequence[Path]) -> dict[str, Any] | None:
    """Return the columns of files that need no description: each quantity under its own name, with its unit in the
    head.

    ``devin --record`` writes such files. None where the first is none.
    """
    table = load_table(files[0])
    stated = {name: unit for head in table.columns for name, unit in [named(head)] if unit is not None}
    if not {"time", "position", "force"} <= stated.keys():
        return None
    return {quantity: {"name": quantity} for quantity in QUANTITIES if quantity in stated}


def _draft(files: Sequence[Path], description: Path) -> str:
    """Propose a column description from the first file, for a person to complete."""
    columns = describe(files[0]).columns.replace("\n", "\n    ")
    return (
        f"write {description} with what each column is ({', '.join(QUANTITIES)}; position and force are needed, leave "
        f"out the others; sioms reconcile describe asks for the rest), for instance\n    {columns}"
    )


def read_layout(folder: Path, model: AxisModel) -> Session:
    """Read ``rec_*.npz`` with counts, cmd16, force, force_meas and index."""
    records = []
    for path in sorted(folder.glob("rec_*.npz")):
        raw = load_table(path).columns
        for needed in ("counts", "force"):
            if needed not in raw:
                raise BadInputError(f"read {path.name}: no array {needed}; has {', '.join(sorted(raw))}")
        q = model.resolution
        records.append(
            Record(
                path.stem,
                raw["counts"] * q,
                raw["force"],
                raw["cmd16"] * q / 16 if "cmd16" in raw else None,
                raw.get("force_meas"),
                raw["index"] > 0.5 if "index" in raw else None,
                raw["t_ms"] * 1e-3 if "t_ms" in raw else None,
            )
        )
    return Session(tuple(records))


def read_model(path: Path) -> AxisModel:
    """Read a model file: TOML, or the ``nominal.json`` of the layout.

    Raises:
        BadInputError: a key is missing, unknown or no number.
    """
    where = f"read model {path}"
    raw = contents(path, where)
    if path.suffix != ".json":
        return model_from(parsed(raw, where), where)
    try:
        given = json_of(raw)
    except ValueError as e:
        raise BadInputError(f"{where}: {e}") from e
    if not isinstance(given, Mapping):
        raise BadInputError(f"{where}: it holds {given!r:.40}; needs an object")
    return model_from(_of_layout(given, where), where)


def _of_layout(n: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Put ``nominal.json`` into the tables of a model file."""
    axis = {key: n[name] for key, name in LAYOUT_AXIS.items() if name in n}
    axis["rated_force"] = number(n, "inertia", where) * number(n, "max_acceleration", where)
    c = table_in(n, "controller", where)
    return {
        "axis": axis,
        "controller": {key: c[name] for key, name in LAYOUT_CONTROLLER.items() if name in c},
    }
