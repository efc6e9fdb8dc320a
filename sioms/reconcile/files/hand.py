"""``sioms reconcile hand``: read recorded grasps of a two-fingered hand, and analyse them.

A file is a table (CSV, NPZ or MAT) with one row for each hold of one object under one load, in SI units::

    time, grasp                                 s, number of the grasp
    kind, thing, size                           1 a disk, 2 a bar, 0 another; number of the object; radius or width, m
    x1, y1, th1, x2, y2, th2                    joints as the encoders read them, m and rad
    place1, place2, load1, load2                place of contact on each finger, rad; load along its normal, N
    cmd_x1, cmd_y1, cmd_th1, cmd_x2, ...        commanded joints (may be missing)
    fx1, fy1, fx2, fy2                          forces of the object on each finger, of the wrists, N (may be missing)
    slip                                        finger that begins to slide, 1 or 2, else 0 (may be missing)

A size that is not known is nan. Every file is a recording of its own: the joints were homed before it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sioms.hand.model import HandModel
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.contents import contents
from sioms.reconcile.files.table import SUFFIXES, load_columns
from sioms.reconcile.given import parsed
from sioms.reconcile.hand.belief import HandBelief, friction
from sioms.reconcile.hand.grasps import Floats, Grasps
from sioms.reconcile.hand.model_file import Noise, from_table
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.verdict import SensorVerdict

JOINTS = tuple(f"{joint}{finger}" for finger in (1, 2) for joint in ("x", "y", "th"))
COMMANDS = tuple(f"cmd_{joint}" for joint in JOINTS)
PLACES, LOADS = ("place1", "place2"), ("load1", "load2")
RECORDED = ".mcap"
GRASPS_N = (0.2, 4.0)
WRISTS = ("fx1", "fy1", "fx2", "fy2")
NEEDED = ("time", "grasp", "kind", "thing", "size", *JOINTS, *PLACES, *LOADS)
COLUMNS = (*NEEDED, *COMMANDS, *WRISTS, "slip")
"""All columns, in the order in which recordings write them."""


def reconcile_hand(
    data: Path, model: Path, seed: int = 1, progress: Callable[[str], None] = lambda text: None
) -> SensorVerdict:
    """Read and analyse one hand.

    Args:
        data: file of recorded grasps, or a folder of such files.
        model: nominal hand, TOML.
        seed: of permutations and bootstrap, 0 or more.
        progress: told what is being done.

    Raises:
        BadInputError: data or model cannot be used.
    """
    from sioms.reconcile.hand.subject import reconcile
    from sioms.reconcile.sensors.analyse import Options

    nominal, noise = read_model(model)
    return reconcile(read_grasps(data), nominal, noise, Options(seed=seed, progress=progress))


def read_model(path: Path) -> tuple[SensorModel, Noise]:
    """Read a hand's model file.

    Raises:
        BadInputError: it is missing or makes no sense.
    """
    return from_table(parsed(contents(path, f"read model {path}"), f"read model {path}"), str(path))


def read_grasps(data: Path) -> Grasps:
    """Read all recorded grasps; recordings of workcells beside them are left out.

    Raises:
        BadInputError: something is missing or not understood.
    """
    if not data.exists():
        raise BadInputError(f"read {data}: no such file or folder")
    files = [data] if data.is_file() else sorted(p for p in data.iterdir() if p.suffix in SUFFIXES)
    if not data.is_file() and any(p.suffix != RECORDED for p in files):  # recordings beside their grasps
        files = [p for p in files if p.suffix != RECORDED]
    if not files:
        raise BadInputError(f"read {data}: no data files; expects one of {', '.join(SUFFIXES)}")
    if files[0].suffix == RECORDED:
        raise BadInputError(
            f"read {files[0]}: a recording of a workcell does not say what was grasped; `sioms hand record -o FILE.csv "
            f"--from {files[0]}` with --disk or --bar writes the grasps that it holds"
        )
    parts = [grasps_of(load_columns(path), path.name, i) for i, path in enumerate(files)]
    later = np.cumsum([0, *(int(p.grasp.max(initial=0)) + 1 for p in parts)])
    columns = {name: np.concatenate([getattr(p, name) for p in parts]) for name in Grasps.__slots__}
    columns["grasp"] = np.concatenate([p.grasp + first for p, first in zip(parts, later[:-1], strict=True)])
    return Grasps(**columns)


def grasps_of(table: Mapping[str, Floats], name: str, record: int) -> Grasps:
    """Return the grasps of one table.

    Args:
        name: of the file, for messages; record: its number.

    Raises:
        BadInputError: a column is missing, unknown, of another length, or holds fractions where numbers count.
    """
    odd = sorted(set(table) - set(COLUMNS))
    if odd:
        raise BadInputError(f"read {name}: nobody reads column {', '.join(odd)}; known are {', '.join(COLUMNS)}")
    missing = [c for c in NEEDED if c not in table]
    for group in (COMMANDS, WRISTS):
        missing += [c for c in group if c not in table and any(k in table for k in group)]
    if missing:
        raise BadInputError(f"read {name}: no column {', '.join(missing)}; has {', '.join(sorted(table))}")
    n = len(table["time"])
    short = [c for c in table if table[c].shape != (n,)]
    if short:
        raise BadInputError(
            f"read {name}: column {short[0]} has {table[short[0]].size} rows, time has {n}; needs as many"
        )

    def of(names: tuple[str, ...]) -> Floats:
        return np.stack([table.get(c, np.full(n, np.nan)) for c in names], axis=1)

    def whole(column: str) -> NDArray[np.int64]:
        values = table.get(column, np.zeros(n))
        if not np.array_equal(values, np.round(values)):
            raise BadInputError(
                f"read {name}: column {column} holds fractions or what is no number; needs whole numbers"
            )
        return values.astype(np.int64)

    return Grasps(
        time=table["time"], record=np.full(n, record, dtype=np.int64), grasp=whole("grasp"), kind=whole("kind"),
        thing=whole("thing"), size=table["size"], command=of(COMMANDS), joints=of(JOINTS), place=of(PLACES),
        load=of(LOADS), wrist=of(WRISTS).reshape(-1, 2, 2), slip=whole("slip"),
    )  # fmt: skip


def known(model: SensorModel) -> HandModel:
    """Return what a hand is known to be, for its driver: the least friction is that of the loads of grasps."""
    b: HandBelief = model.belief()
    loads = np.linspace(*GRASPS_N, 20)
    least = min(float(friction(b, loads, np.full(len(loads), bend)).min()) for bend in b.bend)
    link, mount, joint, gain = ((float(pair[0]), float(pair[1])) for pair in (b.link, b.mount, b.joint, b.gain))
    return HandModel(link, mount, joint, gain, least)
