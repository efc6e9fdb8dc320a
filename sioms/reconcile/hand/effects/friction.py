"""Friction of the fingers' rubber that is not that of the table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from sioms.reconcile.effect import Channel
from sioms.reconcile.hand.belief import HandBelief
from sioms.reconcile.sensors.effect import Quantity, SensorEffect, Values

NAMES = ("friction_level", "friction_load")


def _of_slips(
    name: str, title: str, equation: str, change: Callable[[HandBelief, Values], HandBelief], signature: str,
    *quantities: Quantity,
) -> SensorEffect:  # fmt: skip
    return SensorEffect(
        name=name, title=title, channel=Channel.MECHANICS, change=change, equation=equation, parameters=quantities,
        signature=signature, confounders=tuple(other for other in NAMES if other != name),
        separate="slips under loads that differ by a factor of four or more",
    )  # fmt: skip


EFFECTS = (
    _of_slips(
        "friction_level",
        "coefficient of friction that differs from the table",
        "mu = table mu (1 + share)",
        lambda b, v: replace(b, level=float(v["share"][0])),
        "slips that begin at another ratio of forces, alike at all loads",
        Quantity("share", "1", -0.9, 9.0, 0.1, "relative departure of the coefficient"),
    ),
    _of_slips(
        "friction_load",
        "coefficient of friction that goes with the load",
        "mu = table mu (N/1 N)^(m (1 + c ln(N/1 N))), N the normal force",
        lambda b, v: replace(b, power=float(v["m"][0]), bow=float(v["c"][0])),
        "slips that begin at another ratio of forces the larger the load",
        Quantity("m", "1", -1.0, 1.0, 0.15, "power of the load at 1 N"),
        Quantity("c", "1", -1.0, 1.0, 0.2, "by which the power changes with the logarithm of the load"),
    ),
)
