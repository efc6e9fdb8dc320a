"""The hand's laws in the simulated plane: what they hold, and where their gains end."""

from __future__ import annotations

import math

import pytest
from hand_rig import HAND, RB, HandRig

from sioms.hand.control import Controller, Gains
from sioms.hand.experiments.force import Loop, answer, quasi_static_limit
from sioms.hand.statics import damped_limit, damper_limit, filtered_limit
from sioms.plant.outline import disk
from sioms.plant.planar import Mount

MM = 1e-3
IN_SERIES = 0.275 / 0.140**2 / 2  # N/m: two links
REST = (0.0, 0.0, 0.0, 0.06, math.pi / 2, math.pi / 2)


def test_too_little_force_closes_in_both_laws() -> None:
    for force in (0.0, 0.1):  # free space, contact
        assert Controller(Gains(filter_s=0.0)).rates(REST, [0.0] * 6, REST, 0.5, force, 2.5e-3)[3] < 0.0
    assert Controller(Gains(filter_s=0.0)).rates(REST, [0.0] * 6, REST, 0.5, 0.8, 2.5e-3)[3] > 0.0


def test_the_virtual_spring_rests_where_its_force_is_the_wanted_one() -> None:
    law, d = Controller(Gains(spring=50.0, opening_max=1.0)), 0.08
    for _ in range(2000):
        d += 2.5e-3 * law.rates(REST, [0.0] * 6, (0, 0, 0, d, *REST[4:]), 0.5, 0.0, 2.5e-3)[3]
    assert 50.0 * (REST[3] - d) == pytest.approx(0.5, rel=1e-6)


def test_errors_in_all_coordinates_die_away_in_free_space() -> None:
    rig = HandRig(disk(10 * MM), [0.5, 0.5, 0.0], 80 * MM, 0.0)
    rig.goal = [5 * MM, -8 * MM, 0.2, 90 * MM, math.pi / 2 + 0.2, math.pi / 2 - 0.1]
    rig.run(2.5)
    now = HAND.forward(rig.actual)
    assert now == pytest.approx(rig.goal, abs=2e-5)


def _force(share: float, sample_s: float, time_s: float) -> list[float]:
    """Return the force, sample by sample, from 0.3 N towards 0.35 N, at a share of the limit of the damper's gain."""
    mount = Mount(damping_ratio=1.0)
    damping = math.sqrt(mount.turn_stiffness * mount.inertia) / 0.140**2
    gain = share * damped_limit(IN_SERIES, damping, sample_s)
    gains = Gains(damper=gain, filter_s=0.0, opening_max=10.0, position=1e-6)
    rig = HandRig(disk(30 * MM), [0, 0, 0], 2 * (30 * MM + RB), 0.3, mount, Gains(opening_max=0.5))
    rig.run(2.0)
    rig.controller, rig.tick_s, rig.wanted = Controller(gains), sample_s, 0.35
    seen = []
    for _ in range(round(time_s / sample_s)):
        rig.run(sample_s, steps=round(sample_s / 0.25e-3))
        seen.append(rig.force)
    return seen


def test_at_twenty_hertz_the_damper_settles_below_its_limit_and_not_above() -> None:
    half = _force(0.5, 0.05, 2.0)
    assert max(half) < 0.35 + 0.1 * 0.05 and half[-1] == pytest.approx(0.35, abs=1e-3)
    below, above = (max(tail) - min(tail) for tail in (_force(share, 0.05, 3.0)[-10:] for share in (0.9, 1.3)))
    assert below < 0.01 and above > 0.2
    assert damped_limit(IN_SERIES, 0.0, 0.05) == pytest.approx(damper_limit(IN_SERIES, 0.05))


@pytest.mark.parametrize(("sample_s", "filter_s"), [(2.5e-3, 0.05), (2.5e-3, 0.02), (2.5e-3, 0.0), (0.05, 0.0)])
def test_what_the_hand_takes_for_a_stable_gain_is_one(sample_s: float, filter_s: float) -> None:
    loop, mount = Loop(sample_s, filter_s), Mount(damping_ratio=1.0)
    limit = min(quasi_static_limit(loop, mount), filtered_limit(filter_s, sample_s))
    found = answer(loop, 0.95 * limit, mount, 1.0)
    assert found.overshoot < 0.1 and found.swing < 0.2  # of a step; what is left of a slow approach swings, too


def test_above_that_links_ring_long_before_the_quasi_static_limit() -> None:
    loop, mount = Loop(2.5e-3, 0.02), Mount(damping_ratio=1.0)
    gain = 1.6 * filtered_limit(0.02, 2.5e-3)
    assert gain < 0.5 * quasi_static_limit(loop, mount)
    assert answer(loop, gain, mount, 1.0).swing > 0.5


@pytest.mark.parametrize("name", ["position", "spring", "damper"])
def test_gains_that_cannot_be_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        Gains(**{name: 0.0})
    with pytest.raises(ValueError, match="filter_s"):
        Gains(filter_s=-1.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_no_rate_comes_out_of_what_is_not_known(bad: float) -> None:
    law = Controller(Gains())
    with pytest.raises(ValueError, match="want finite numbers"):
        law.rates(REST, [0.0] * 6, REST, 0.5, bad, 2.5e-3)
    with pytest.raises(ValueError, match="want finite numbers"):
        law.rates(REST, [0.0] * 6, (*REST[:3], bad, *REST[4:]), 0.5, 0.1, 2.5e-3)
    assert law.felt == 0.0


def test_what_was_wanted_before_a_pause_is_forgotten() -> None:
    law = Controller(Gains(filter_s=0.05, opening_max=10.0))
    for _ in range(100):
        law.rates(REST, [0.0] * 6, REST, 1.0, 1.0, 2.5e-3)
    law.feel(1.0, 2.5e-3)
    law.feel(1.0, 2.5e-3)  # a sample in which nothing is asked for
    assert law.opening(0.06, 0.0, 0.06, 0.0, True) == pytest.approx(0.4 * law.felt, rel=1e-9)
    law.feel(1.0, 2.5e-3)
    assert 0.0 < law.opening(0.06, 0.0, 0.06, 1.0, True) < 0.4  # a step of the wanted force comes smoothly
