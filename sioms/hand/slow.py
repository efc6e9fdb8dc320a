"""A simulated cell of a hand in slow motion: the same motion, forces and places, in a multiple of the time.

A machine that is too slow or too busy for the cell's loops carries the same skills out that way. With pace p every time
becomes 1/p as long: velocities are p times, accelerations and what stands for forces over mass p^2 times what they
were, while lengths, forces and stiffnesses stay. Masses and inertias grow by 1/p^2, dampings by 1/p; friction on the
platen, which goes with the weight, keeps its force. So the trajectory is the same curve, and a fault is the same fault.

Pure: tables in, tables out.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sioms.documents import toml_value

SLOWEST = 0.01
PROCESS = "simulation"
"""In which all simulated devices of a slowed cell are: on a busy machine most of a tick is to be woken for it."""
_FOLLOWS_S, _JITTER_S = 0.5, 0.01
"""What velocity_max covers in these times an axis may be behind, and be pushed, that says nothing else."""
Table = dict[str, Any]

_AXIS = {
    "velocity_max": (1, None), "acceleration_max": (2, None), "jerk_max": (3, None), "velocity_filter_s": (-1, None),
    "bandwidth_hz": (1, None),
}  # fmt: skip
_MOUNT = {"mass": (-2, 1.0), "inertia": (-2, 5e-4), "loss_s": (-1, 1.0), "shear_loss_s": (-1, 3e-4)}
_SQUEEZE = {
    "damper": (1, 0.4), "spring_rate": (1, 5.0), "filter_s": (-1, 0.05), "opening_max": (1, 0.1), "damping": (-1, 0.6),
    "age_max_s": (-1, 0.05),
}  # fmt: skip
_TOUCH = {"damper": (1, 0.2), "filter_s": (-1, 0.005), "age_max_s": (-1, 0.05)}
_POWERS: dict[str, Table] = {
    "sim-axes": {
        "tick_hz": (1, 1000.0), "world_age_max_s": (-1, 0.05),
        "axis": {**_AXIS, "bandwidth_hz": (1, 30.0), "motor": {"mass": (-2, None), "viscous": (-1, None)}},
    },
    "sim-world": {
        "tick_hz": (1, 1000.0), "step_s": (-1, 0.25e-3),
        "object": {"mass": (-2, 0.1), "platen_friction": (2, 0.2)},
        "finger": {"mount": _MOUNT},
    },
    "sim-tactile": {"tick_hz": (1, 200.0)},
    "sim-force": {"tick_hz": (1, 1000.0)},
    "hand": {
        "tick_hz": (1, 400.0), "lease_s": (-1, None), "late_max_s": (-1, 0.05), "pace": (1, 1.0),
        "axis": {**_AXIS, "gain": (1, 20.0)}, "squeeze": _SQUEEZE, "touch": _TOUCH,
    },
}  # fmt: skip
"""Of each driver: by which power of the pace a key goes, and what it is where the configuration does not say."""
_FILES = ("finger_file", "model_file", "effects_file")


def slowed(tables: Mapping[str, Any], pace: float, folder: Path) -> Table:
    """Return the tables of a cell's configuration at a pace.

    Args:
        tables: as they are at pace 1, or at another pace, on top of which this one goes.
        pace: of its time, from 0.01 to 1.
        folder: of the configuration; files that it names are named by their whole path.

    Raises:
        ValueError: a pace out of its range, tables that are none of a cell, or a device whose driver has no simulation
            that can be slowed.
    """
    if not SLOWEST <= pace <= 1.0:
        raise ValueError(f"slow cell: a pace of {pace:g}; want {SLOWEST:g} to 1")
    found: Table = copy.deepcopy(dict(tables))
    _want_tables("", found)
    _want_tables("device.", found.get("device", {}))
    for name, device in found.get("device", {}).items():
        powers = _POWERS.get(device.get("driver", ""))
        if powers is None:
            raise ValueError(
                f"slow cell: device {name} has the driver {device.get('driver')!r}; want {', '.join(_POWERS)}"
            )
        models = [axis.get("model_file") for axis in _axes(device)]
        if any(models) or device.get("effects") or device.get("effects_file"):
            raise ValueError(f"slow cell: device {name} has effects, whose times stay; want none")
        _keep_limits(device)
        _scale(device, powers, pace)
        if device["driver"].startswith("sim-"):
            device.setdefault("process", PROCESS)
        _whole_paths(device, folder)
    # The order sets the phases of ticks: the hand comes 0.38 of a period after the process of its fingers, not 0.62.
    found["device"] = dict(
        sorted(found.get("device", {}).items(), key=lambda item: item[1]["driver"].startswith("sim-"))
    )
    return found


def _want_tables(above: str, tables: Table) -> None:
    for name, one in tables.items():
        if not all(isinstance(table, dict) for table in (one if isinstance(one, list) and not above else [one])):
            raise ValueError(f"slow cell: {above}{name} = {toml_value(one)}; want a table")


def _axes(device: Table) -> list[Table]:
    axes = device.get("axis", [])
    return [axis for axis in axes if isinstance(axis, dict)] if isinstance(axes, list) else []


def _keep_limits(device: Table) -> None:
    """Say how far axes may be behind and be pushed, which else go with their velocities: forces bend as far as ever."""
    for axis in _axes(device):
        fastest = _number("velocity_max", axis.get("velocity_max", 1.0))
        axis.setdefault("following_error_max", _FOLLOWS_S * fastest)
        watch = axis.get("watch", {})
        _want_tables("", {"watch": watch})
        axis["watch"] = {"tolerance": _JITTER_S * fastest, **watch}


def _scale(table: Table, powers: Mapping[str, Any], pace: float) -> None:
    for key, power in powers.items():
        if isinstance(power, tuple):
            exponent, usual = power
            value = table.get(key, usual)
            if value is not None:
                table[key] = _number(key, value) * pace**exponent
            continue
        below = table.get(key)
        if below is None and key == "mount":
            below = table[key] = {}
        for one in below if isinstance(below, list) else [below]:
            if one is not None:
                _want_tables("", {key: one})
                _scale(one, power, pace)


def _number(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"slow cell: {key} = {toml_value(value)}; want a number")
    return value


def _whole_paths(table: Table, folder: Path) -> None:
    for key, value in table.items():
        if isinstance(value, dict):
            _whole_paths(value, folder)
        elif key in _FILES and value:
            table[key] = str((folder / value).resolve())
