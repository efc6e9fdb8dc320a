"""Read a folder of tactile recordings: `*.npz` tables of frames and the finger as built.

Each npz holds raw (frames, ns), time, touch (-1 without), phase (0 baseline, 1 under load, 2 other), fs, and
may hold force and temperature; touch experiments add cmd_theta [deg], cmd_P [N/m] and cmd_rc [mm] for each
touch (0 edge, inf flat). Files named noise, thermal and ramp are what they say.  The finger is nominal.toml,
or nominal.json with radii and angles.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sioms.tactile.cylinder import Cylinder
from sioms.tactile.finger import Elements, Finger, from_toml, nominal_finger
from sioms.tactile.touches import Recording, Touches, average


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
    for path in sorted(folder.glob("*.npz")):
        try:
            with np.load(path) as file:
                recordings[path.stem] = recording = _recording(file)
                if "cmd_theta" in file:
                    angle, load = np.radians(file["cmd_theta"]), file["cmd_P"].astype(float)
                    radius = 1e-3 * file["cmd_rc"]
                    touches[path.stem] = average(recording, angle, load, radius, nominal.signal.scale)
        except (ValueError, KeyError, OSError) as error:
            raise ValueError(f"read {path}: {error}") from error
    if not touches:
        raise ValueError(
            f"read {folder}: no *.npz with touches (cmd_theta, cmd_P, cmd_rc); record some first"
        )
    return Data(nominal, touches, recordings)


def read_recording(path: Path) -> Recording:
    """Read the frames of one npz.

    Raises:
        ValueError: a file that makes no sense; the message names it.
        OSError: the file cannot be read.
    """
    try:
        with np.load(path) as file:
            return _recording(file)
    except (ValueError, KeyError, EOFError) as error:
        raise ValueError(f"read {path}: {error}") from error


def _recording(file: Any) -> Recording:
    raw = np.asarray(file["raw"], dtype=np.float64)
    frames = raw.shape[0]

    def column(name: str, fallback: float) -> Any:
        return file[name] if name in file else np.full(frames, fallback)

    return Recording(
        raw=raw,
        time_s=np.asarray(file["time"], dtype=np.float64),
        touch=np.asarray(column("touch", -1)).astype(np.int64),
        phase=np.asarray(column("phase", 2)).astype(np.int64),
        force=np.asarray(column("force", np.nan), dtype=np.float64),
        temperature_c=np.asarray(column("temperature", np.nan), dtype=np.float64),
        rate_hz=float(file["fs"]),
    )


def read_nominal(folder: Path) -> Finger:
    """Read the finger as built from nominal.toml or nominal.json."""
    text = folder / "nominal.toml"
    if text.exists():
        return from_toml(text.read_text(encoding="utf-8"))
    path = folder / "nominal.json"
    if not path.exists():
        raise ValueError(
            f"read {folder}: neither nominal.toml nor nominal.json; describe the finger as built"
        )
    tree = json.loads(path.read_text(encoding="utf-8"))
    try:
        body = Cylinder(1e-3 * tree["ra_mm"], 1e-3 * tree["rb_mm"], tree["poisson"], tree["shear_modulus_pa"])
        angles = np.radians(tree["element_angle_deg"])
        radii = tuple(1e-3 * r for r in tree["element_radius_mm"])
        gains = tuple(float(g) for g in tree["gain_percent_strain_per_percent_output"])
        noise = 0.01 * float(tree.get("output_noise_percent", 0.05))
    except KeyError as error:
        raise ValueError(f"read {path}: key {error} is missing") from error
    finger = nominal_finger(body, angles, radii[0], gains[0], noise, name=folder.name)
    e = finger.elements
    elements = Elements(e.angle_rad, radii, e.poisson, gains, e.quadratic, e.noise, e.misfit, e.used)
    return msgspec.structs.replace(finger, elements=elements)
