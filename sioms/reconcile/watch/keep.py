"""The state of a watch as plain values, and back. What is damaged is left out, and said."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from .axis import KEPT, AxisWatch, Drift
from .blocks import MOST_CROSSINGS, Block, Crossing
from .causes import BY_NAME, Finding
from .moves import Array
from .normal import ALL_NAMES, Normal
from .rows import SIZE

VERSION = 3
_TOTAL = len(ALL_NAMES)
_SHAPES: Mapping[str, tuple[int, ...]] = {
    "gram": (SIZE + 1, SIZE + 1), "freed": (SIZE, SIZE), "theta": (_TOTAL,), "own": (_TOTAL, _TOTAL), "per": (SIZE,),
    "change": (_TOTAL,),
}  # fmt: skip


def packed(watch: AxisWatch, offset_s: float) -> dict[str, Any]:
    """Return what is kept of a watch.

    Args:
        offset_s: UTC minus the axis's clock, which begins anew with its machine: instants are kept in UTC.
    """
    normal, drift = watch.normal, watch.drift
    return {
        "version": VERSION,
        "about": asdict(watch.about) | {"force_max": min(watch.about.force_max, 1e300)},
        "motion_s": watch.motion_s,
        "blocks": [_plain(block, offset_s) for block in watch.blocks],
        "normal": None if normal is None else _plain(normal, offset_s),
        "drift": None if drift is None else _plain(drift, offset_s) | {"finding": _plain(drift.finding, 0.0)},
    }


def restore(watch: AxisWatch, kept: Any, offset_s: float) -> str:
    """Let a watch go on with what was kept.

    Returns:
        Why not, '' where it goes on.
    """
    try:
        if not isinstance(kept, dict) or kept.get("version") != VERSION:
            found = kept.get("version") if isinstance(kept, dict) else None
            raise ValueError(f"it is of version {str(found)[:20]}; want {VERSION}")
        about = asdict(watch.about) | {"force_max": min(watch.about.force_max, 1e300)}
        other = [key for key, value in about.items() if kept["about"].get(key) != value]
        if other:
            raise ValueError(f"it is of an axis with another {', '.join(other)}")
        blocks = [_block(each, offset_s) for each in list(kept["blocks"])[-KEPT:]]
        normal = None if kept["normal"] is None else _normal(kept["normal"], offset_s)
        drift = None if kept["drift"] is None else _drift(kept["drift"], offset_s)
        motion_s = _number(kept["motion_s"])
    except (TypeError, ValueError, KeyError, AttributeError, OverflowError) as error:
        return f"its state of before is not used: {error if str(error) else type(error).__name__}"
    watch.blocks.extend(blocks)
    watch.normal, watch.drift, watch.motion_s = normal, drift, motion_s
    return ""


def _plain(value: Any, offset_s: float) -> dict[str, Any]:
    """Return the fields of a dataclass as numbers, texts and lists."""
    out: dict[str, Any] = {}
    for field in fields(value):
        each = getattr(value, field.name)
        if isinstance(each, np.ndarray):
            out[field.name] = [float(f"{x:.12g}") for x in each.ravel()]
        elif isinstance(each, tuple) and each and isinstance(each[0], Crossing):
            out[field.name] = [[c.place, c.way, c.speed] for c in each]
        elif isinstance(each, float):
            shift = offset_s if field.name in ("start_s", "end_s", "until_s", "since_s", "told_s") else 0.0
            out[field.name] = each + shift if math.isfinite(each) else None
        elif not isinstance(each, Finding):
            out[field.name] = each
    return out


def _number(value: Any, most: float = 1e15) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= most:
        raise ValueError(f"{str(value)[:40]!r} is not a number in range")
    return float(value)


def _maybe(value: Any) -> float:
    return math.nan if value is None else _number(value)


def _array(table: Mapping[str, Any], name: str) -> Array:
    shape = _SHAPES[name]
    out = np.array([_number(x, 1e300) for x in table[name]], dtype=np.float64)
    return out.reshape(shape)


def _block(t: Mapping[str, Any], offset_s: float) -> Block:
    crossings = tuple(Crossing(_number(p), _way(w), _number(v)) for p, w, v in list(t["crossings"])[:MOST_CROSSINGS])
    return Block(
        _number(t["start_s"]) - offset_s, _number(t["end_s"]) - offset_s, _number(t["motion_s"]), int(t["rows"]),
        _array(t, "gram"), _array(t, "freed"), _maybe(t["least"]), _maybe(t["most"]), _number(t["error"]), crossings,
    )  # fmt: skip


def _way(value: Any) -> int:
    return int(np.copysign(2 if abs(_number(value)) > 1 else 1, value))


def _normal(t: Mapping[str, Any], offset_s: float) -> Normal:
    own, per = _array(t, "own"), _array(t, "per")
    if np.any(np.linalg.eigvalsh(own) < -1e-9 * np.trace(own)) or np.any(per < 0.0) or not _number(t["force"]) > 0.0:
        raise ValueError("what was normal makes no sense")
    return Normal(
        _array(t, "theta"), own, _number(t["noise"]), _number(t["force"]), per, t["loads"] is True, _number(t["least"]),
        _number(t["most"]), tuple(_number(x) for x in t["edges"]), _number(t["scatter"]), _number(t["error"]),
        int(t["blocks"]), _number(t["until_s"]) - offset_s, _maybe(t.get("turned")),
        _maybe(t.get("loose")),
    )  # fmt: skip


def _drift(t: Mapping[str, Any], offset_s: float) -> Drift:
    f = t["finding"]
    names = tuple(str(n) for n in t["names"])
    if not set(names) <= set(BY_NAME):
        raise ValueError(f"no such cause: {', '.join(names)[:80]}")
    finding = Finding(
        _number(f["gain"], 1e300), names, _maybe(f["size"]), _maybe(f["low"]), _maybe(f["high"]), _array(f, "change"),
        str(f["ordered"])[:80], _number(f["share"]),
    )  # fmt: skip
    return Drift(
        names, finding, _number(t["since_s"]) - offset_s, _number(t["told_s"]) - offset_s, t["serious"] is True
    )
