"""Read what people have: column files with a short TOML, the layout with ``nominal.json``, model files.

Column description (``columns.toml`` beside the data, or ``--columns``)::

    sample_time_s = 0.001            # or a time column
    files = ["run1.csv", "run2.npz"] # optional; else every data file of the folder, by name
    continuous = true                # heat carries over from file to file
    final = ["run9.csv"]             # optional: whole records that only the final statement sees
    [columns]
    time           = { name = "t",    unit = "s" }
    position       = { name = "qm",   unit = "m" }       # m mm um rad deg turn count
    command        = { name = "qg",   unit = "m" }
    force          = { name = "vir",  unit = "N", scale = 35.15 }  # N mN kN, N m, mN m; value * scale
    force_measured = { name = "cur",  unit = "N" }
    index          = { name = "idx" }

A column that the data do not have, or a key that nobody reads, is an error.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.model_file import only, parse_model
from sioms.reconcile.records import Record, Session

Array = NDArray[np.float64]
UNITS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "rad": 1.0, "deg": np.pi / 180.0, "turn": 2.0 * np.pi, "s": 1.0, "ms": 1e-3,
         "us": 1e-6, "ns": 1e-9, "N": 1.0, "mN": 1e-3, "kN": 1e3, "N m": 1.0, "mN m": 1e-3, "V": 1.0, "A": 1.0, "1": 1.0}
QUANTITIES = ("time", "position", "command", "force", "force_measured", "index")
SUFFIXES = (".csv", ".npz", ".mat", ".txt")


def read_data(data: Path, model: AxisModel, columns: Path | None = None) -> Session:
    """Read all records of one axis.

    Args:
        data: a file, a folder of files, or a folder of the layout with ``nominal.json``.
        columns: column description; by default ``columns.toml`` beside the data.

    Raises:
        BadInputError: something is missing or not understood.
    """
    if not data.exists():
        raise BadInputError(f"read {data}: no such file or folder")
    folder = data if data.is_dir() else data.parent
    description = columns or folder / "columns.toml"
    if columns is None and data.is_dir() and list(data.glob("rec_*.npz")) and not description.exists():
        return read_layout(data, model)
    if not description.exists():
        raise BadInputError(f"read {data}: no column description; write {description.name} beside it or give --columns")
    with description.open("rb") as f:
        try:
            table = tomllib.load(f)
        except tomllib.TOMLDecodeError as e:
            raise BadInputError(f"read {description}: {e}") from e
    only(table, ("sample_time_s", "files", "continuous", "final", "columns"), str(description))
    last = [folder / n for n in table.get("final", ())]
    files = [folder / n for n in table["files"]] if "files" in table else [f for f in _files(data) if f not in last]
    if not files:
        raise BadInputError(f"read {data}: no data files; expects one of {', '.join(SUFFIXES)}")
    records, final = (tuple(_record(f, table.get("columns", {}), model) for f in some) for some in (files, last))
    return Session(records, bool(table.get("continuous", True)), final)


def _files(data: Path) -> list[Path]:
    return [data] if data.is_file() else sorted(p for p in data.iterdir() if p.suffix in SUFFIXES)


def load_columns(path: Path) -> dict[str, Array]:
    """Read the columns of one file."""
    if not path.exists():
        raise BadInputError(f"read {path}: no such file")
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as z:
            return {k: np.asarray(z[k], dtype=np.float64) for k in z.files if z[k].ndim == 1}
    if path.suffix == ".mat":
        from scipy.io import loadmat

        raw = loadmat(path, squeeze_me=True)
        return {k: np.asarray(v, dtype=np.float64) for k, v in raw.items()
                if not k.startswith("__") and np.ndim(v) == 1}
    with path.open() as f:
        head = f.readline()
    sign = next((c for c in ",;\t" if c in head), ",")
    names = [n.strip().strip('"') for n in head.split(sign)]
    try:
        table = np.loadtxt(path, delimiter=sign, skiprows=1, ndmin=2)
    except ValueError as e:
        raise BadInputError(f"read {path}: {e}; needs one head line of names and numbers below") from e
    if table.shape[1] != len(names):
        raise BadInputError(f"read {path}: {len(names)} names over {table.shape[1]} columns")
    return {n: np.ascontiguousarray(table[:, i]) for i, n in enumerate(names)}


def _record(path: Path, columns: Mapping[str, Any], model: AxisModel) -> Record:
    raw = load_columns(path)
    only(columns, QUANTITIES, "the column description")
    found: dict[str, Array] = {}
    for quantity, spec in columns.items():
        only(spec, ("name", "unit", "scale", "offset"), f"column {quantity}")
        if spec.get("name") not in raw:
            raise BadInputError(f"read {path.name}: no column {spec.get('name')!r} for {quantity}; has {', '.join(sorted(raw))}")
        found[quantity] = _convert(quantity, raw[spec["name"]], spec, model)
    for needed in ("position", "force"):
        if needed not in found:
            raise BadInputError(f"read {path.name}: the column description names no {needed}; it is needed")
    index = found.get("index")
    return Record(path.stem, found["position"], found["force"], found.get("command"), found.get("force_measured"),
                  None if index is None else index > 0.5, found.get("time"))


def _convert(quantity: str, raw: Array, spec: Mapping[str, Any], model: AxisModel) -> Array:
    unit = spec.get("unit", "1")
    if unit == "count":
        factor = model.resolution
    elif unit in UNITS:
        factor = UNITS[unit]
    else:
        raise BadInputError(f"read column {quantity}: unit {unit!r} is not known; known are count, {', '.join(UNITS)}")
    return np.asarray((raw * float(spec.get("scale", 1.0)) + float(spec.get("offset", 0.0))) * factor, dtype=np.float64)


def read_layout(folder: Path, model: AxisModel) -> Session:
    """Read ``rec_*.npz`` with counts, cmd16, force, force_meas and index."""
    records = []
    for path in sorted(folder.glob("rec_*.npz")):
        raw = load_columns(path)
        for needed in ("counts", "force"):
            if needed not in raw:
                raise BadInputError(f"read {path.name}: no array {needed}; has {', '.join(sorted(raw))}")
        q = model.resolution
        records.append(Record(path.stem, raw["counts"] * q, raw["force"], raw["cmd16"] * q / 16 if "cmd16" in raw else None,
                              raw.get("force_meas"), raw["index"] > 0.5 if "index" in raw else None,
                              raw["t_ms"] * 1e-3 if "t_ms" in raw else None))
    return Session(tuple(records))


def read_model(path: Path) -> AxisModel:
    """Read a model file: TOML, or the ``nominal.json`` of the layout.

    Raises:
        BadInputError: a key is missing, unknown or no number.
    """
    if not path.exists():
        raise BadInputError(f"read model {path}: no such file")
    if path.suffix != ".json":
        return parse_model(path.read_text(), str(path))
    try:
        return _layout_model(json.loads(path.read_text()))
    except (KeyError, TypeError) as e:
        raise BadInputError(f"read model {path}: missing or wrong key {e}") from e
    except ValueError as e:
        raise BadInputError(f"read model {path}: {e}") from e


def _layout_model(n: Mapping[str, Any]) -> AxisModel:
    c = n["controller"]
    return AxisModel(
        rotary=n["kind"] == "rotary", sample_time_s=n["sample_time"], inertia=n["inertia"], viscous=n["viscous"],
        resolution=n["encoder_resolution"], pitch=n["index_pitch"], rated_force=n["inertia"] * n["max_acceleration"],
        max_speed=n["position_max_speed"], start_position=n.get("start_position", 0.0), name=n.get("scenario", "axis"),
        controller=Controller(c["k"], c["kz"], c["kp"], c["kb"], c["tau_o"], c["tau_m"], c["vel_filter_hz"]))


def with_resolution(model: AxisModel, session: Session) -> AxisModel:
    """Fill in a resolution of zero by the smallest step of the recorded position."""
    if model.resolution > 0.0:
        return model
    steps = np.abs(np.concatenate([np.diff(r.position) for r in session.records]))
    top = float(np.max([np.max(np.abs(r.position)) for r in session.records]))
    moved = steps[steps > 1e-9 * max(top, 1e-12)]
    if not len(moved):
        raise BadInputError("read records: position is constant; needs motion")
    return replace(model, resolution=float(np.min(moved)))
