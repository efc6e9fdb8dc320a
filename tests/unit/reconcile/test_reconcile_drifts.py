"""The bench of the watch: what counts as false, and plays that look like shifted places."""

from __future__ import annotations

import copy
from functools import cache

from sioms.bench.drifts import Axis, _injected, commissioned, quiet

TICK_S = 0.001


@cache
def axis() -> Axis:
    return commissioned(41, 0, 0.25)


def test_production_without_a_drift_is_quiet_and_one_with_a_drift_is_not() -> None:
    day = quiet(copy.deepcopy(axis()), 0.3)
    assert day.told == () and day.motion_s > 300.0 and 0.0 < day.spent_s < 0.05 * day.motion_s
    worn = copy.deepcopy(axis())
    worn.machine = worn.day.machine = worn.machine.drifted("dry", 1.2)
    (told,) = quiet(worn, 0.3).told
    assert "axis0: dry friction has grown" in told


def test_a_mass_is_told_of_an_axis_that_carries_changing_loads() -> None:
    carrying = commissioned(41, 2, 0.3)
    assert carrying.watch.normal is not None and carrying.watch.normal.loads
    name, after_s = _injected(carrying, "mass", 0.4)
    assert name == "mass" and after_s < 300.0
