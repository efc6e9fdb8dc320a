"""``sioms reconcile force``: read recorded known loads and readings of a force/torque sensor, and analyse them.

Column description (``columns.toml`` beside the data, or ``--columns``)::

    files = ["up.csv", "down.npz"]     # optional; else every data file of the folder, by name
    [columns]
    time = { name = "t", unit = "s" }
    temperature = { name = "temp", unit = "C" }     # may be missing
    [load]                                          # known loads; a component that is missing was not loaded
    fx = { name = "weight_x", unit = "N" }
    [reading]
    fx = { name = "sensor_x", unit = "mN", scale = 1.0 }

A column that the data do not have, or a key that nobody reads, is an error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.contents import contents
from sioms.reconcile.files.table import SUFFIXES, load_columns
from sioms.reconcile.force.model_file import from_table
from sioms.reconcile.force.plan import Plan
from sioms.reconcile.force.records import ForceRecords, unit_of
from sioms.reconcile.given import columns_in, only, parsed, words
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.verdict import SensorVerdict

UNITS = {
    "N": 1.0,
    "mN": 1e-3,
    "kN": 1e3,
    "kgf": 9.80665,
    "N m": 1.0,
    "mN m": 1e-3,
    "N mm": 1e-3,
    "N cm": 1e-2,
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
    "C": 1.0,
    "K": 1.0,
    "1": 1.0,
}
#: Descriptions of columns, by quantity.
Specs = Mapping[str, Mapping[str, Any]]
FORCES, TORQUES = ("N", "mN", "kN", "kgf", "1"), ("N m", "mN m", "N mm", "N cm", "1")


def reconcile_force(
    data: Path,
    model: Path,
    columns: Path | None = None,
    seed: int = 1,
    progress: Callable[[str], None] = lambda text: None,
    plans: Sequence[Plan] = (),
) -> SensorVerdict:
    """Read and analyse one force/torque sensor.

    Args:
        data: file or folder of recordings: time, known load and reading of each component.
        model: nominal sensor (TOML): components, their full ranges [N, N m] and the matrix.
        columns: column description; None takes ``columns.toml`` beside the data.
        seed: of permutations and bootstrap, 0 or more.
        progress: told what is being done.
        plans: programmes of loads that can be applied to decide between confounders.

    Returns:
        The verdict; loads and readings as shares of each component's full range.

    Raises:
        BadInputError: data or model cannot be used.
    """
    from sioms.reconcile.force.subject import prepare
    from sioms.reconcile.sensors.analyse import Options, analyse

    nominal, names = read_model(model)
    subject = prepare(read_loads(data, names, columns), nominal, plans)
    return analyse(subject, Options(seed=seed, progress=progress))


def read_model(path: Path) -> tuple[SensorModel, tuple[str, ...]]:
    """Read a sensor's model file.

    Raises:
        BadInputError: it is missing or makes no sense.
    """
    return from_table(_toml(path, "model"), str(path))


def _toml(path: Path, what: str) -> dict[str, Any]:
    return parsed(contents(path, f"read {what} {path}"), f"read {what} {path}")


def read_loads(data: Path, names: tuple[str, ...], columns: Path | None = None) -> ForceRecords:
    """Read all records.

    Raises:
        BadInputError: something is missing or not understood.
    """
    if not data.exists():
        raise BadInputError(f"read {data}: no such file or folder")
    folder = data if data.is_dir() else data.parent
    description = columns or folder / "columns.toml"
    table = _toml(description, "column description")
    where = f"read {description}"
    only(table, ("files", "columns", "load", "reading"), where)
    own = columns_in(table, "columns", ("time", "temperature"), where)
    loads, readings = (columns_in(table, part, names, where) for part in ("load", "reading"))
    missing = [n for n in names if n not in readings]
    if missing:
        raise BadInputError(
            f"read {description}: no reading of {', '.join(missing)}; every component of the model needs one"
        )
    chosen = words(table, "files", where, "names of files")
    files = (
        [folder / n for n in chosen]
        if chosen is not None
        else ([data] if data.is_file() else sorted(p for p in data.iterdir() if p.suffix in SUFFIXES))
    )
    if not files:
        raise BadInputError(f"read {data}: no data files; expects one of {', '.join(SUFFIXES)}")
    parts = [_record(f, own, loads, readings, names) for f in files]
    load, reading, clock, warm = (np.concatenate([p[i] for p in parts]) for i in range(4))
    record = np.concatenate([np.full(len(p[2]), i) for i, p in enumerate(parts)])
    return ForceRecords(names, load, reading, clock, warm, record)


def _record(path: Path, own: Specs, load: Specs, reading: Specs, names: tuple[str, ...]) -> tuple[Any, ...]:
    raw = load_columns(path)
    count = len(next(iter(raw.values()))) if raw else 0
    loads = [_column(raw, load, n, path, count) for n in names]
    readings = [_column(raw, reading, n, path, count) for n in names]
    clock = _column(raw, own, "time", path, count) if "time" in own else np.full(count, np.nan)
    warm = _column(raw, own, "temperature", path, count) if "temperature" in own else np.full(count, np.nan)
    return np.stack(loads, axis=1), np.stack(readings, axis=1), clock, warm


def _column(raw: Mapping[str, Any], specs: Specs, name: str, path: Path, count: int) -> Any:
    if name not in specs:
        return np.zeros(count)
    spec = specs[name]
    if spec.get("name") not in raw:
        raise BadInputError(
            f"read {path.name}: no column {spec.get('name')!r} for {name}; has {', '.join(sorted(raw))}"
        )
    unit = spec.get("unit", "1")
    allowed = tuple(UNITS) if name in ("time", "temperature") else TORQUES if unit_of(name) == "N m" else FORCES
    if unit not in allowed:
        raise BadInputError(f"read column {name}: unit {unit!r} is not known; known are {', '.join(allowed)}")
    values = raw[spec["name"]]
    if len(values) != count:
        raise BadInputError(
            f"read {path.name}: column {spec['name']} has {len(values)} rows, others {count}; needs the same number"
        )
    return (values * float(spec.get("scale", 1.0)) + float(spec.get("offset", 0.0))) * UNITS[unit]
