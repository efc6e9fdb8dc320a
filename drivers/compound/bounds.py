"""Numbers that a coordinate of a compound may have: what measures no machine is refused when it is configured.

There are no infinite ones: where an axis has no bound, its key is left out. Wide enough for slow motion at a hundredth.
"""

from __future__ import annotations

from typing import Any

_OF_AN_AXIS: dict[str, tuple[float, float]] = {
    "position_min": (-1e6, 1e6), "position_max": (-1e6, 1e6), "velocity_max": (1e-9, 1e4),
    "acceleration_max": (1e-9, 1e7), "jerk_max": (1e-9, 1e10), "force_max": (1e-9, 1e9),
    "velocity_filter_s": (0.0, 10.0), "following_error_max": (1e-9, 1e6), "deadband": (0.0, 1e3),
    "damper": (0.0, 1e6), "force_age_s": (1e-4, 3600.0),
}  # fmt: skip
_LEAST_GAIN, _TOLERANCE, _SCALE = 1e-6, (1e-9, 1e6), (1e-9, 1e9)
_LATEST_S = 60.0


def check(settings: Any) -> None:
    """Refuse numbers of a compound and its coordinates.

    Args:
        settings: `CompoundSettings`.

    Raises:
        ValueError: with a sentence.
    """
    if not 1.0 / settings.tick_hz <= settings.late_max_s <= _LATEST_S:
        raise ValueError(
            f"late_max_s {settings.late_max_s:g}; want at least a tick, {1 / settings.tick_hz:g} s, and at most "
            f"{_LATEST_S:g} s"
        )
    for axis in settings.axis:
        for name, (least, most) in _OF_AN_AXIS.items():
            _within(axis, name, getattr(axis, name), least, most)
        _within(axis, "gain", axis.gain, _LEAST_GAIN, 0.5 * settings.tick_hz)
        _within(axis, "watch.tolerance", axis.watch.tolerance, *_TOLERANCE)
        if not _SCALE[0] <= abs(axis.force_scale) <= _SCALE[1]:
            raise ValueError(
                f"axis {axis.name}: force_scale {axis.force_scale:g}; want {_SCALE[0]:g} to "
                f"{_SCALE[1]:g}, of either sign"
            )


def _within(axis: Any, name: str, value: float | None, least: float, most: float) -> None:
    if value is not None and not least <= value <= most:
        raise ValueError(f"axis {axis.name}: {name} {value:g}; want {least:g} to {most:g}")
