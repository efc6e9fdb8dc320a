"""Read a folder of tactile recordings: `*.npz` tables of frames, or `*.mcap` of one node, and the finger as built.

Each npz holds raw (frames, ns), time, touch (-1 without), phase (0 baseline, 1 under load, 2 other), fs, and
may hold force and temperature; touch experiments add cmd_theta [deg], cmd_P [N/m] and cmd_rc [mm] for each
touch (0 edge, inf flat). Beside an mcap `NAME.touches.csv` has a line for each touch: base_s, start_s and end_s
after the beginning of the recording (rest from base_s on, load from start_s on), and the same cmd columns.
Files named noise, thermal and ramp are what they say.  The finger is nominal.toml, or nominal.json with radii and
angles.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from sioms.documents import json_of, read_bytes, read_text
from sioms.lab.arrays import read_npz
from sioms.protocol.flags import NodeClass
from sioms.recording.tables import head_of, of_one_node
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.finger import Elements, Finger, from_toml, nominal_finger
from sioms.tactile.touches import Recording, Touches, average

Floats = NDArray[np.float64]

_UNREADABLE = (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile)
_THINNEST_M = 0.1e-3  # no indenter is rounder, no finger smaller: the number must be of another unit


@dataclass(frozen=True, slots=True)
class Data:
    """Hold a folder's content: the finger as built, touch experiments by name, all recordings by name."""

    nominal: Finger
    touches: dict[str, Touches]
    recordings: dict[str, Recording]


def read_folder(folder: Path) -> Data:
    """Read all recordings of a folder.

    Raises:
        ValueError: nothing to read, or a file that makes no sense; the message names the file.
        OSError: the folder cannot be read.
    """
    nominal = read_nominal(folder)
    recordings, touches = {}, {}
    for path in sorted([*folder.glob("*.npz"), *folder.glob("*.mcap")]):
        try:
            file = _opened(path)
            recordings[path.stem] = recording = _recording(file)
            if "cmd_theta" in file:
                touches[path.stem] = average(recording, *_commanded(file), nominal.signal.scale)
        except _UNREADABLE as error:
            raise ValueError(f"read {path}: {_words(error)}") from error
    if not touches:
        raise ValueError(f"read {folder}: no *.npz with touches (cmd_theta, cmd_P, cmd_rc); record some first")
    return Data(nominal, touches, recordings)


def read_recording(path: Path) -> Recording:
    """Read the frames of one npz.

    Raises:
        ValueError: a file that makes no sense; the message names it.
        OSError: the file cannot be read.
    """
    try:
        return _recording(_opened(path))
    except _UNREADABLE as error:
        raise ValueError(f"read {path}: {_words(error)}") from error


def _opened(path: Path) -> dict[str, Any]:
    path.stat()
    if path.suffix == ".mcap":
        return _recorded(path)
    if not zipfile.is_zipfile(path):
        raise ValueError("this is no npz archive; want arrays raw and time, as numpy.savez writes them")
    return read_npz(path)


def _recorded(path: Path) -> dict[str, Any]:
    """Return the frames of a recording, and the touches that are listed beside it."""
    info, columns = of_one_node(path, NodeClass.ANALOG)
    heads = [head_of(info, channel, "data") for channel in range(len(info.channels))]
    time_s = columns["time [s]"] - columns["time [s]"][0]
    found: dict[str, Any] = {"raw": np.stack([columns[head] for head in heads], axis=1), "time": time_s}
    if (listed := path.with_suffix(".touches.csv")).exists():
        touches = np.atleast_1d(np.genfromtxt(listed, delimiter=",", names=True))
        names = ("base_s", "start_s", "end_s", "cmd_theta", "cmd_P", "cmd_rc")
        if missing := [name for name in names if name not in (touches.dtype.names or ())]:
            raise ValueError(f"{listed.name} has no column {missing[0]}; want {', '.join(names)}")
        found["touch"], found["phase"] = np.full(len(time_s), -1), np.full(len(time_s), 2)
        for number, touch in enumerate(touches):
            for phase, begin, end in ((0, "base_s", "start_s"), (1, "start_s", "end_s")):
                inside = (time_s >= touch[begin]) & (time_s < touch[end])
                found["touch"][inside], found["phase"][inside] = number, phase
        found |= {name: touches[name] for name in names[3:]}
    return found


def _words(error: BaseException) -> str:
    if isinstance(error, KeyError):
        return f"{error.args[0]} is missing; want at least raw and time, with touches also cmd_theta, cmd_P and cmd_rc"
    return str(error)


def _commanded(file: Any) -> tuple[Floats, Floats, Floats]:
    """Return places [rad], loads [N/m] and indenters [m] of the touches."""
    columns = [np.asarray(file[name], dtype=np.float64) for name in ("cmd_theta", "cmd_P", "cmd_rc")]
    sizes = [column.shape for column in columns]
    if len(set(sizes)) != 1 or columns[0].ndim != 1:
        raise ValueError(f"cmd_theta, cmd_P and cmd_rc have shapes {sizes}; want one number each for every touch")
    angle, load, radius = np.radians(columns[0]), columns[1], 1e-3 * columns[2]
    if not (np.isfinite(angle).all() and np.isfinite(load).all() and np.all(radius >= 0.0)):
        raise ValueError("cmd_theta, cmd_P or cmd_rc holds a value that is not finite, or a negative radius")
    if np.any((radius > 0.0) & (radius < _THINNEST_M)):
        raise ValueError(
            f"cmd_rc holds {columns[2][(radius > 0.0)].min():g} mm; an indenter so thin is none: give mm, 0 for an edge"
        )
    return angle, load, radius


def _recording(file: Any) -> Recording:
    raw = np.asarray(file["raw"], dtype=np.float64)
    if raw.ndim != 2:
        raise ValueError(f"raw has shape {raw.shape}; want frames by elements")
    frames, time_s = raw.shape[0], np.asarray(file["time"], dtype=np.float64)
    falls = np.flatnonzero(~(np.diff(time_s) >= 0.0))
    if falls.size:
        raise ValueError(
            f"time falls or is not a number after frame {falls[0]}; want the frames in the order of their times"
        )

    def column(name: str, fallback: float) -> Any:
        return file[name] if name in file else np.full(frames, fallback)

    return Recording(
        raw=raw,
        time_s=time_s,
        touch=_whole(column("touch", -1), "touch"),
        phase=_whole(column("phase", 2), "phase"),
        force=np.asarray(column("force", np.nan), dtype=np.float64),
        temperature_c=np.asarray(column("temperature", np.nan), dtype=np.float64),
        rate_hz=float(file["fs"]) if "fs" in file else (frames - 1) / max(float(np.ptp(time_s)), 1e-9),
    )


def _whole(values: Any, name: str) -> NDArray[np.int64]:
    numbers = np.asarray(values, dtype=np.float64)
    if not np.all(numbers == np.round(numbers)):
        raise ValueError(f"{name} holds a value that is not an integer")
    return numbers.astype(np.int64)


def read_nominal(folder: Path) -> Finger:
    """Read the finger as built from nominal.toml or nominal.json."""
    if not folder.is_dir():
        raise ValueError(f"read {folder}: no such folder; want one with recordings and nominal.toml")
    text = folder / "nominal.toml"
    if text.exists():
        return from_toml(read_text(text))
    path = folder / "nominal.json"
    if not path.exists():
        raise ValueError(f"read {folder}: neither nominal.toml nor nominal.json; describe the finger as built")
    try:
        return _built(json_of(read_bytes(path)), folder.name)
    except KeyError as error:
        raise ValueError(f"read {path}: key {error} is missing") from error
    except (ValueError, TypeError, IndexError) as error:
        raise ValueError(f"read {path}: {error}") from error


def _built(tree: dict[str, Any], name: str) -> Finger:
    body = Cylinder(1e-3 * tree["ra_mm"], 1e-3 * tree["rb_mm"], tree["poisson"], tree["shear_modulus_pa"])
    if body.outer_m < 10.0 * _THINNEST_M:
        raise ValueError(f"rb_mm is {tree['rb_mm']:g}; a finger so thin is none: give mm")
    angles = np.radians(tree["element_angle_deg"])
    if angles.size and np.degrees(np.ptp(angles)) < 0.5 * (angles.size - 1):
        raise ValueError(
            f"element_angle_deg puts {angles.size} elements within {np.degrees(np.ptp(angles)):.3g} degrees; give "
            "degrees"
        )
    radii = tuple(1e-3 * r for r in tree["element_radius_mm"])
    gains = tuple(float(g) for g in tree["gain_percent_strain_per_percent_output"])
    finger = nominal_finger(
        body, angles, radii[0], gains[0], 0.01 * float(tree.get("output_noise_percent", 0.05)), name=name
    )
    e = finger.elements
    elements = Elements(e.angle_rad, radii, e.poisson, gains, e.quadratic, e.noise, e.misfit, e.used)
    return msgspec.structs.replace(finger, elements=elements)
