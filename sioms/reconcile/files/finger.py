"""``sioms reconcile tactile``: read a finger's recordings and its nominal model, analyse, write what came out.

The folder is that of ``sioms tactile`` (docs/tactile.md): one npz per experiment. Arrays of other names or units are
named in a ``columns.toml`` beside them::

    [columns]
    raw = { name = "dc", unit = "1" }          # fractions instead of per cent
    cmd_theta = { name = "angle", unit = "rad" }
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sioms.documents import read_text, toml_of
from sioms.lab.arrays import UnreadableError, read_npz
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.contents import contents
from sioms.reconcile.files.table import NUMBERS
from sioms.reconcile.finger.belief import Belief
from sioms.reconcile.finger.model_file import belief_of, check, corrected, from_table, to_toml
from sioms.reconcile.given import columns_in, only, parsed
from sioms.reconcile.sensors.effect import SensorModel
from sioms.tactile.files import read_nominal
from sioms.tactile.finger import Finger, from_toml
from sioms.tactile.finger import to_toml as finger_to_toml
from sioms.tactile.touches import Recording
from sioms.whole_file import write_whole

if TYPE_CHECKING:
    from sioms.reconcile.finger.plan import Bench
    from sioms.reconcile.finger.prepare import Experiment
    from sioms.reconcile.sensors.verdict import SensorVerdict

#: Arrays, the unit they come in, and what other units are worth in it.
ARRAYS: dict[str, tuple[str, dict[str, float]]] = {
    "raw": ("%", {"%": 1.0, "1": 100.0}),
    "time": ("s", {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}),
    "touch": ("1", {"1": 1.0}),
    "phase": ("1", {"1": 1.0}),
    "force": ("N/m", {"N/m": 1.0, "N/mm": 1e3, "N/cm": 1e2}),
    "temperature": ("C", {"C": 1.0, "K": 1.0}),
    "cmd_theta": ("deg", {"deg": 1.0, "rad": 180.0 / np.pi}),
    "cmd_P": ("N/m", {"N/m": 1.0, "N/mm": 1e3, "N/cm": 1e2}),
    "cmd_rc": ("mm", {"mm": 1.0, "m": 1e3}),
    "fs": ("Hz", {"Hz": 1.0, "kHz": 1e3}),
}


def reconcile_tactile(
    data: Path,
    model: Path | None,
    seed: int = 1,
    progress: Callable[[str], None] = lambda text: None,
    bench: Bench | None = None,
) -> SensorVerdict:
    """Read and analyse one tactile finger.

    Args:
        data: folder with one npz for each experiment: ``raw`` (frames, elements) in per cent, ``time`` [s], ``touch``,
            ``phase``, and of each touch ``cmd_theta`` [deg], ``cmd_P`` [N/m], ``cmd_rc`` [mm].
        model: nominal finger (TOML or JSON); None takes ``nominal.json`` in the folder.
        seed: of permutations and bootstrap, 0 or more.
        progress: told what is being done.
        bench: what touches can be made to decide between confounders.

    Returns:
        The verdict; lengths in m, angles in rad, loads in N/m, outputs as fractions.

    Raises:
        BadInputError: data or model cannot be used.
    """
    from sioms.reconcile.finger.prepare import prepare
    from sioms.reconcile.sensors.analyse import Options, analyse

    nominal, name, stated = read_model(model or data, data)
    subject = prepare(read_experiments(data), nominal, name, refine_extent=not stated, bench=bench)
    return analyse(subject, Options(seed=seed, progress=progress))


def read_model(path: Path, data: Path) -> tuple[Belief, str, bool]:
    """Read the nominal finger: a finger's file, a model of this command, or nominal.json / nominal.toml in a folder.

    Returns:
        What the simulation believes, the name, and whether the width of the elements is stated.

    Raises:
        BadInputError: the file is missing or makes no sense.
    """
    if not path.exists():
        raise BadInputError(f"read model {path}: no such file")
    try:
        if path.is_dir() or path.suffix == ".json":
            finger = read_nominal(path if path.is_dir() else path.parent)
            return _checked(belief_of(finger), str(path)), data.name, False
        text = read_text(path)
        table = toml_of(text)
        if "finger" in table:
            m, stated = from_table(table, str(path))
            return m.belief(), m.name, stated
        finger = from_toml(text)
        return _checked(belief_of(finger), str(path)), finger.name, False
    except BadInputError:
        raise
    except (OSError, ValueError, json.JSONDecodeError) as e:
        raise BadInputError(f"read model {path}: {e}") from e


def _checked(b: Belief, where: str) -> Belief:
    check(b, where)
    return b


def read_experiments(data: Path) -> list[Experiment]:
    """Read every npz of a folder.

    Raises:
        BadInputError: there is none, or one lacks an array or holds one of the wrong length.
    """
    from sioms.reconcile.finger.prepare import Experiment

    if not data.is_dir():
        raise BadInputError(f"read {data}: no such folder; needs one npz for each experiment")
    columns = _columns(data / "columns.toml")
    out = []
    for path in sorted(data.glob("*.npz")):
        try:
            raw = read_npz(path)
        except UnreadableError as error:
            raise BadInputError(str(error)) from None
        arrays = {k: np.asarray(v, dtype=np.float64) for k, v in raw.items() if v.dtype.kind in NUMBERS}
        got = _named(arrays, columns, path.name)
        out.append(Experiment(path.stem, _recording(got, path.name), _touches(got, path.name)))
    if not out:
        raise BadInputError(f"read {data}: no *.npz; needs one for each experiment")
    return out


def _columns(path: Path) -> Mapping[str, Mapping[str, Any]]:
    if not path.exists():
        return {}
    table = parsed(contents(path, f"read {path}"), f"read {path}")
    only(table, ("columns",), f"read {path}")
    return columns_in(table, "columns", ARRAYS, f"read {path}", keys=("name", "unit"), named=False)


def _named(arrays: Mapping[str, Any], columns: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Give the arrays the names and units of the folder's layout."""
    out = {k: v for k, v in arrays.items() if k in ARRAYS and k not in columns}
    for name, spec in columns.items():
        given, factors = spec.get("name", name), ARRAYS[name][1]
        unit = spec.get("unit", ARRAYS[name][0])
        if unit not in factors:
            raise BadInputError(f"read {where}: unit {unit!r} of {name} is not known; known are {', '.join(factors)}")
        if given in arrays:
            out[name] = arrays[given] * factors[unit]
    return out


def _recording(got: Mapping[str, Any], where: str) -> Recording:
    for name in ("raw", "time"):
        if name not in got:
            raise BadInputError(f"read {where}: no array {name}; has {', '.join(sorted(got)) or 'none that is known'}")
    raw = got["raw"]
    frames = len(raw)

    def column(name: str, fallback: float) -> Any:
        return got[name] if name in got else np.full(frames, fallback)

    clock = got["time"]
    if len(clock) != frames or np.any(np.diff(clock) < 0.0) or not np.isfinite(clock).all():
        raise BadInputError(
            f"read {where}: time has {len(clock)} stamps for {frames} frames or does not rise; needs one for each frame"
        )
    step = float(np.median(np.diff(clock))) if frames > 1 else 0.0
    rate = float(got["fs"]) if "fs" in got else 1.0 / step if step > 0.0 else 1.0
    if step > 0.0 and "touch" in got and np.any(got["touch"] >= 0) and not 0.5 < step * rate < 2.0:
        raise BadInputError(
            f"read {where}: time steps are {step:g} s at fs {rate:g} Hz, a factor of {step * rate:.4g}; needs seconds"
        )
    try:
        return Recording(
            raw,
            clock,
            np.nan_to_num(column("touch", -1.0), nan=-1.0).astype(np.int64),
            np.nan_to_num(column("phase", 2.0), nan=2.0).astype(np.int64),
            column("force", np.nan),
            column("temperature", np.nan),
            rate,
        )
    except ValueError as e:
        raise BadInputError(f"read {where}: {e}") from e


def _touches(got: Mapping[str, Any], where: str) -> tuple[Any, Any, Any] | None:
    if "cmd_theta" not in got:
        return None
    for name in ("cmd_P", "cmd_rc", "touch", "phase"):
        if name not in got:
            raise BadInputError(
                f"read {where}: no array {name} beside cmd_theta; touches need cmd_theta, cmd_P, cmd_rc, touch, phase"
            )
    place, load, radius = np.radians(got["cmd_theta"]), got["cmd_P"], 1e-3 * got["cmd_rc"]
    if not len(place) == len(load) == len(radius):
        raise BadInputError(
            f"read {where}: {len(place)} places, {len(load)} loads, {len(radius)} radii; needs one of each per touch"
        )
    return place, load, radius


def write_models(verdict: SensorVerdict, model: Path | None, out: Path) -> None:
    """Write model.toml (switchable effects) and finger.toml, what driver and estimator load."""
    write_whole(out / "model.toml", to_toml(verdict.model))
    nominal: Finger | None = None
    if model is not None and model.is_file() and model.suffix == ".toml":
        text = read_text(model)
        if "finger" not in toml_of(text):
            nominal = from_toml(text)
    dead = tuple(int(p.value) for e in verdict.effects if e.name == "dead_element" for p in e.parameters)
    write_whole(out / "finger.toml", finger_to_toml(corrected(_named_only(verdict.model), nominal, dead)))


def _named_only(model: SensorModel) -> SensorModel:
    """Leave nameless terms out of what is installed."""
    for name in [n for n in model.effects if n.startswith("term_")]:
        model = model.without_effect(name)
    return model
