"""Friction of the fingers' rubber that is not that of the table."""

from __future__ import annotations

from dataclasses import replace

from sioms.reconcile.effect import Channel
from sioms.reconcile.hand.belief import HandBelief
from sioms.reconcile.sensors.effect import Quantity, SensorEffect, Values


def _levelled(b: HandBelief, v: Values) -> HandBelief:
    return replace(b, level=float(v["share"][0]))


def _powered(b: HandBelief, v: Values) -> HandBelief:
    return replace(b, power=float(v["m"][0]))


LEVEL = SensorEffect(
    name="friction_level",
    title="coefficient of friction that differs from the table",
    channel=Channel.MECHANICS,
    change=_levelled,
    equation="mu = table mu (1 + share)",
    parameters=(Quantity("share", "1", -0.9, 9.0, 0.1, "relative departure of the coefficient"),),
    signature="slips that begin at another ratio of forces, alike at all loads",
    lookalikes=("friction_load",),
    separate="slips under loads that differ by a factor of four or more",
)
LOAD = SensorEffect(
    name="friction_load",
    title="coefficient of friction that goes with the load",
    channel=Channel.MECHANICS,
    change=_powered,
    equation="mu = table mu (N/1 N)^m, N the normal force",
    parameters=(Quantity("m", "1", -1.0, 1.0, 0.15, "power of the load"),),
    signature="slips that begin at another ratio of forces the larger the load",
    lookalikes=("friction_level",),
    separate="slips under loads that differ by a factor of four or more",
)
EFFECTS = (LEVEL, LOAD)
