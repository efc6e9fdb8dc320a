"""Rows of grasps out of a recording of a workcell (``sioms record``), whatever the hand did meanwhile."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sioms.hand.felt import felt, no_shape
from sioms.hand.holds import COMMANDS, JOINTS, LOADS, PLACES, WRISTS, Stream, holds
from sioms.protocol.flags import AnalogStatus

if TYPE_CHECKING:
    from sioms.recording.reader import Recording

Floats = NDArray[np.float64]
LENGTH_M = 20e-3  # of the contact along a finger
_INVALID = int(AnalogStatus.INVALID)
_MODULE = 3  # joints of a module: x, y, th


def rows_from(
    path: Path, what: Sequence[float], hand: str, fingers: Sequence[str], modules: Sequence[str], wrists: Sequence[str],
    first: int = 0,
) -> list[list[float]]:  # fmt: skip
    """Return the rows of a survey that a recording holds.

    Args:
        path: of the recording.
        what: was grasped: kind, number and size [m] as a row has them.
        hand: its node, whose ``force`` shows the pace of a simulated hand; that is 1 where it is not recorded.
        fingers, modules, wrists: nodes of what each finger feels, of the axes x, y, th, and of force sensors, none or
            two.
        first: number of the first grasp.

    Raises:
        OSError: it cannot be read, or a node is not in it.
        ValueError: a node is of another kind, or there is no hold in it; the sentence says what would be right.
    """
    from sioms.recording.reader import Recording

    with Recording(path) as recording:
        pace = _pace(recording, f"{hand}.force")
        streams = [_module(recording, name, i, pace) for i, name in enumerate(modules)]
        streams += [_finger(recording, name, i, pace) for i, name in enumerate(fingers)]
        streams += [_wrist(recording, name, i, pace) for i, name in enumerate(wrists)]
        if recording.damage:
            raise ValueError(f"read {path}: {recording.damage[0]}; `sioms log cut` takes what is whole before or after")
    found = holds(streams)
    if not found:
        raise ValueError(
            f"read {path}: there is no hold in it; want both fingers touched, and joints and loads at rest for two "
            "seconds of the hand's time"
        )
    begin = found[0][0]
    return [[at - begin, first + grasp, *what, *told, 0.0] for at, grasp, *told in found]


def _pace(recording: Recording, node: str) -> float:
    if node not in recording.nodes:
        return 1.0
    names = [channel.name for channel in recording.node(node).info.channels]
    shown = recording.table(node, ["data"]).values["data"]
    return float(shown[0, names.index("pace")]) if "pace" in names and len(shown) else 1.0


def _seconds(stamps_ns: NDArray[np.int64], pace: float) -> Floats:
    return np.asarray(stamps_ns * (1e-9 * pace))


def _module(recording: Recording, name: str, which: int, pace: float) -> Stream:
    table = recording.table(name, ["position", "following_error"])
    at = table.values["position"].astype(np.float64)
    if at.shape[1] != _MODULE:
        raise ValueError(f"read module {name}: it has {at.shape[1]} axes; want x, y and th")
    own = range(_MODULE * which, _MODULE * (which + 1))
    columns = *(JOINTS.start + i for i in own), *(COMMANDS.start + i for i in own)
    told = np.concatenate([at, at + table.values["following_error"]], axis=1)
    return Stream(_seconds(table.stamps_ns, pace), told, columns)


def _finger(recording: Recording, name: str, which: int, pace: float) -> Stream:
    if why := no_shape(name, [channel.name for channel in recording.node(name).info.channels]):
        raise ValueError(f"read finger {why}")
    table = recording.table(name, ["data", "flags"])
    values, touched = np.full((len(table.stamps_ns), 2), math.nan), np.zeros(len(table.stamps_ns), dtype=np.bool_)
    invalid = (table.values["flags"].astype(np.int64)[:, 0] & _INVALID) != 0
    for i, shape in enumerate(table.values["data"].tolist()):
        one = felt(shape, LENGTH_M)
        touched[i] = bool(one.touched) and not invalid[i]
        if touched[i] and not one.doubt:
            values[i] = one.phi, one.force
    return Stream(_seconds(table.stamps_ns, pace), values, (PLACES.start + which, LOADS.start + which), touched)


def _wrist(recording: Recording, name: str, which: int, pace: float) -> Stream:
    table = recording.table(name, ["data", "flags"])
    invalid = (table.values["flags"].astype(np.int64)[:, :2] & _INVALID) != 0
    told = np.where(invalid, math.nan, table.values["data"][:, :2])
    return Stream(_seconds(table.stamps_ns, pace), told, (WRISTS.start + 2 * which, WRISTS.start + 2 * which + 1))
