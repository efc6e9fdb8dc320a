"""The watch of axes in production: moves, numbers of an axis, what is normal, causes, state, proposals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sioms.documents import json_of, json_text
from sioms.reconcile.watch.axis import About, AxisWatch, Settings
from sioms.reconcile.watch.blocks import Block, Collector, Crossing, solved
from sioms.reconcile.watch.causes import judge
from sioms.reconcile.watch.keep import packed, restore
from sioms.reconcile.watch.moves import Cutter, Samples
from sioms.reconcile.watch.normal import ALL_NAMES, TOTAL, Estimate, Normal, estimate, learn
from sioms.reconcile.watch.propose import Gains, margin
from sioms.reconcile.watch.rows import (
    CONSTANT,
    DRY,
    GAP,
    GIVE,
    MASS,
    PLAYS,
    SIZE,
    VISCOUS,
    Rows,
    kernels,
    rows_of,
    wind_up,
)  # fmt: skip

TICK_S = 0.001
ABOUT = About("mod0.xaxis", False, TICK_S, 100.0, 0.4, 1e-6, 0.5)


def samples(position: np.ndarray, force: np.ndarray, start_s: float = 0.0, moving: slice = slice(60, -60)) -> Samples:
    n = len(position)
    moves = np.zeros(n, dtype=np.bool_)
    moves[moving] = True
    time_s = start_s + TICK_S * np.arange(n)
    return Samples(time_s, position, force, position, np.gradient(position, TICK_S), moves, np.ones(n, dtype=np.bool_))


def swing(n: int = 1500, size: float = 0.1) -> np.ndarray:
    t = TICK_S * np.arange(n)
    return np.asarray(size * np.sin(2 * np.pi * 1.3 * t) * np.sin(2 * np.pi * 0.4 * t))


def test_kernels_give_the_derivatives_of_polynomials() -> None:
    k = kernels(8.0)
    t = np.arange(len(k)) - len(k) // 2
    for power in range(5):
        for order in range(5):
            falling = np.prod(np.arange(power - order + 1, power + 1)) if order <= power else 0.0
            even = {0: 1.0, 2: 1.0, 4: 3.0}.get(power - order, 0.0)
            assert k[:, order] @ (t / 8.0) ** power == pytest.approx(falling * even / 8.0**order, abs=1e-9)


def test_the_numbers_of_an_exact_motion_come_out() -> None:
    x = swing()
    v = np.gradient(x, TICK_S)
    a = np.gradient(v, TICK_S)
    u = 2.0 * a + 8.0 * v + 3.0 * np.sign(v) + 0.5
    held = np.append(u[1:] + u[:-1], 2 * u[-1]) / 2  # what is commanded at a tick acts until the next one
    rows = rows_of(samples(x, held), TICK_S, 0.5, PLAYS * 0.4, None)
    assert rows is not None
    table = np.column_stack([rows.x, rows.y])
    theta, _, left = solved(table.T @ table)
    assert theta[[MASS, VISCOUS, DRY, CONSTANT]] == pytest.approx([2.0, 8.0, 3.0, 0.5], rel=0.03)
    assert left / len(rows.y) < 0.05**2


def test_a_play_is_passed_between_one_push_and_the_other() -> None:
    t = TICK_S * np.arange(400)
    a = np.where(t < 0.2, 5.0, -5.0)
    v = np.cumsum(a) * TICK_S
    x = np.cumsum(v) * TICK_S
    wind = wind_up(x, v, a, np.array([1e-4, 4e-4]), TICK_S)
    assert wind[100] == pytest.approx([0.5e-4, 2e-4]) and wind[-1] == pytest.approx([-0.5e-4, -2e-4])
    taken = np.sum(np.abs(wind) < 0.499 * np.array([1e-4, 4e-4]), axis=0) * TICK_S
    assert taken == pytest.approx(np.sqrt(2 * np.array([1e-4, 4e-4]) / 5.0), abs=2.1e-3)  # free way under its brake


def test_moves_are_the_same_however_the_samples_come_in_pieces() -> None:
    one = samples(swing(), swing())
    both = one.and_then(samples(swing(900), swing(900), 1.5))
    whole = list(Cutter(TICK_S, 100.0).feed(both.and_then(samples(np.zeros(100), np.zeros(100), 2.4, slice(0, 0)))))
    rng = np.random.default_rng(3)
    for _ in range(20):
        cutter, found, at = Cutter(TICK_S, 100.0), [], 0
        padded = both.and_then(samples(np.zeros(100), np.zeros(100), 2.4, slice(0, 0)))
        while at < len(padded):
            to = min(at + int(rng.integers(1, 400)), len(padded))
            found += cutter.feed(padded.part(at, to))
            at = to
        assert [(len(m), m.time_s[0]) for m in found] == [(len(m), m.time_s[0]) for m in whole]
    assert len(whole) == 2


def test_what_is_pressed_stopped_or_torn_is_no_move() -> None:
    good = samples(swing(), swing())
    usable = good.usable.copy()
    usable[700] = False
    assert all(len(m) < 1000 for m in Cutter(TICK_S, 100.0).feed(replace(good, usable=usable)))
    assert not list(Cutter(TICK_S, 100.0).feed(replace(good, force=np.full(len(good), 99.0))))
    torn = good.time_s.copy()
    torn[700:] += 0.05
    moves = list(Cutter(TICK_S, 100.0).feed(replace(good, time_s=torn)))
    assert all(np.ptp(np.diff(m.time_s)) < 1e-6 for m in moves)


def normal(**changes: float) -> Normal:
    """An axis of 2 kg, 8 N s/m and 4 N, whose numbers vary by a percent or two of its force."""
    theta, own = np.zeros(TOTAL), np.full(TOTAL, 1e-3)
    theta[[MASS, VISCOUS, DRY]] = 2.0, 8.0, 4.0
    own[[MASS, VISCOUS, DRY, CONSTANT]] = 0.02, 0.3, 0.08, 0.05
    own[GIVE] = 1e-6
    own[SIZE:] = 1e-5, 1e-4, 1e-5, 1e-4
    per = np.array([2.5, 0.3, 1.0, 1.0, 50.0, 1e4, 5.0, 5.0, 5.0])
    return Normal(theta, np.diag(own**2), 0.01, 7.0, per, False, 2.0, 2.0, (0.03, 0.08), 1e-6, 1e-10, 100, 0.0)


def now(reference: bool = True, **changes: float) -> Estimate:
    was = normal()
    theta = was.theta.copy()
    for name, change in changes.items():
        theta[ALL_NAMES.index(name)] += change
    noise = np.diag((0.1 * np.sqrt(np.diag(was.own))) ** 2)
    if not reference:
        noise[SIZE:, SIZE:] = np.eye(TOTAL - SIZE) * 1e12
    gram = np.zeros((SIZE + 1, SIZE + 1))
    gram[np.arange(SIZE), np.arange(SIZE)] = 1000 * was.per**2
    return Estimate(theta, noise, 0.01, gram, 1000)


def test_each_cause_is_told_by_its_pattern() -> None:
    cases = {
        "dry friction": {"dry": 2.0},
        "viscous friction": {"viscous": 6.0},
        "mass": {"mass": 0.4},
        "lower force": {"mass": 0.5, "viscous": 2.0, "dry": 1.0},
        "place": {"place": 5e-4},
        "scale": {"mass": -0.1, "viscous": -0.4, "scale": 0.05},
        "friction": {"dry": 2.0, "viscous": -6.0},
    }
    for name, change in cases.items():
        found = judge(normal(), now(**change), 0.4)
        assert found.is_drift and found.names == (name,), (name, found.names)
        assert found.low <= found.size <= found.high


def test_what_does_not_separate_is_left_open_and_what_is_unknown_unnamed() -> None:
    assert not judge(normal(), now(dry=0.1, viscous=0.3), 0.4).is_drift
    alike = judge(normal(), now(False, mass=-0.12), 0.4)  # without a reference a scale looks like a mass
    assert alike.is_drift and set(alike.names) >= {"mass", "scale"}
    odd = judge(normal(), now(mass=0.8, dry=-3.0, constant=2.0), 0.4)
    assert odd.is_drift and odd.names == ()
    carried = replace(normal(), loads=True, least=2.0, most=2.6)
    assert not judge(carried, now(mass=0.5), 0.4).is_drift, "loads of that mass are usual there"


def unsure_of_small_play(base: Normal) -> Normal:
    """The same axis, in whose moves the smallest column of play hardly shows; its reference is of micrometres."""
    own = base.own.copy()
    own[GAP, GAP], own[SIZE, SIZE] = 4.0, 1e-12
    return replace(base, own=own)


def test_a_place_is_told_though_the_smallest_play_would_not_show() -> None:
    """A shift by half a millimetre would take a play of a millimetre, which would show in the largest column."""
    was = unsure_of_small_play(normal())
    assert judge(was, now(place=5e-4), 0.4).names == ("place",)
    half_seen = replace(now(place=5e-4), noise=now().noise + np.diag(np.eye(TOTAL)[GAP + 2]))
    assert "backlash" in judge(was, half_seen, 0.4).names, "a mass behind that play cannot be excluded"
    assert "backlash" in judge(was, now(place=2e-5), 0.4).names, "so small a play shows in no column"


def blocks_at(
    rng: np.random.Generator,
    speeds: list[float],
    dry: float,
    viscous: float = 8.0,
    noise: float = 0.1,
    mass: float = 2.0,
) -> list[Block]:
    """Blocks of moves to and fro, each at a speed of its own, of an axis with some force noise [N]."""
    collector, found = Collector(), list[Block]()
    for number, speed in enumerate(speeds * 6):
        t = np.linspace(0.0, 1.0, 500)
        v = (-1.0) ** number * speed * np.clip(8.0 * np.minimum(t, 1.0 - t), 0.1, 1.0)
        x = np.zeros((500, SIZE))
        x[:, MASS], x[:, VISCOUS], x[:, DRY], x[:, CONSTANT] = np.gradient(v, t * 4.0), v, np.sign(v), 1.0
        x[:, CONSTANT + 1 :] = rng.standard_normal((500, SIZE - CONSTANT - 1))
        y = mass * x[:, MASS] + viscous * v + dry * np.sign(v) + 0.5 + noise * rng.standard_normal(500)
        block = collector.add(Rows(x, y, 1e-10, 4.0, 40.0 * number, speed, 0.0))
        found += [block] if block is not None else []
    return found


def test_blocks_of_before_and_after_a_change_are_no_finding_of_both() -> None:
    """Slow moves before, fast ones after more dry friction: together they look like a steep viscous friction."""
    rng = np.random.default_rng(4)
    slow, fast = blocks_at(rng, [0.1, 0.11], 3.0), blocks_at(rng, [0.2, 0.21], 4.4)
    for some in (slow, fast):
        pure = estimate(some, False, (), 0.0, 0.02, 0.4)
        sd = np.sqrt(np.diag(pure.noise))
        assert abs(pure.theta[VISCOUS] - 8.0) < 4.0 * sd[VISCOUS] < 2.0
    both = estimate(slow + fast, False, (), 0.0, 0.02, 0.4)
    assert both.theta[VISCOUS] > 14.0, "sums of both do not tell either"
    assert abs(both.theta[VISCOUS] - 8.0) < 5.0 * np.sqrt(both.noise[VISCOUS, VISCOUS]), "and that shows"


def referred(
    blocks: list[Block], rng: np.random.Generator, edges: tuple[float, ...], scale: float = 0.0
) -> list[Block]:
    """The same blocks with crossings of a reference to and fro, whose position is scaled."""
    passed = [(edge * (1.0 + scale), way) for edge in edges for way in (-1, 1, -1, 1)]
    return [
        replace(b, crossings=tuple(Crossing(at + 1e-6 * rng.standard_normal(), way, 0.2 * way) for at, way in passed))
        for b in blocks
    ]


def test_one_edge_does_not_tell_a_shift_from_a_scale() -> None:
    rng = np.random.default_rng(6)
    speeds, both = [0.05, 0.1, 0.2, 0.3], (0.03, 0.08)
    was = learn(referred(blocks_at(rng, speeds * 5, 3.0), rng, both), 0.4, 1e-6)
    assert was.edges == pytest.approx(both, abs=1e-5)
    later = blocks_at(rng, speeds, 3.0)
    for edges, names in ((both, {"scale"}), (both[:1], {"scale", "place"})):
        seen = estimate(referred(later, rng, edges, 0.005), False, was.edges, was.scatter, was.noise, 0.4)
        assert set(judge(was, seen, 0.4).names) >= names, edges
    assert judge(was, seen, 0.4).names != ("place",)


def test_a_scale_is_told_though_each_block_passes_few_edges() -> None:
    """No block tells anything of the reference by itself: its two crossings are too few."""
    rng = np.random.default_rng(7)
    speeds, both = [0.05, 0.1, 0.2, 0.3], (0.03, 0.08)
    watch = AxisWatch(ABOUT)
    watch.normal = learn(referred(blocks_at(rng, speeds * 5, 3.0), rng, both), 0.4, 1e-6)
    found = []
    for number, block in enumerate(blocks_at(rng, speeds * 6, 3.0)):
        scale, at_s = 0.005 * (number >= 10), 100.0 * number
        (told,) = referred([block], rng, (both[number % 2],), scale)
        watch._take(replace(told, crossings=told.crossings[:2], start_s=at_s, end_s=at_s + 90.0))
        found.append(watch.drift.names if watch.drift is not None else None)
    assert len(found) > 20 and found[10] is None and ("scale",) in found, found
    assert watch.drift is not None and 900.0 <= watch.drift.since_s <= 1300.0


def crossings_of(speed_mps: float, rate: float, edges: list[float]) -> list[Crossing]:
    """Return what a watch keeps of edges [s] in a move of 1.2 s that speeds up and brakes within ``1 / rate``."""
    watch, n = AxisWatch(ABOUT, Settings()), 1200
    t = TICK_S * np.arange(n)
    speed = speed_mps * np.clip(rate * np.minimum(t, t[-1] - t), 0.0, 1.0)
    x = np.cumsum(speed) * TICK_S
    move = replace(samples(x, np.ones(n)), speed=speed)
    watch.feed(move.and_then(samples(np.full(200, x[-1]), np.zeros(200), 1.2, slice(0, 0))), edges)
    return watch._collector.crossings


def test_an_edge_counts_where_the_speed_is_steady() -> None:
    """While an axis brakes, the other flank of a play may bear."""
    (crossing,) = crossings_of(0.2, 4.0, [0.1, 0.6, 1.1])
    assert crossing.place == pytest.approx(0.2 * (0.6 - 0.125), abs=2e-4) and crossing.way == 1


def test_an_edge_counts_where_inertia_says_which_flank_bears() -> None:
    """Speeding up and braking, the load is pushed to and fro; in between a change of speed nothing is said."""
    assert [c.way for c in crossings_of(0.3, 10.0, [0.02, 0.08, 0.11, 0.6, 1.18])] == [2, 1, -2]


def test_a_place_is_told_from_a_play_by_the_edges_under_acceleration() -> None:
    """A play of which one flank bears shifts an edge by half of it; pushed the other way, the edge is elsewhere."""
    rng = np.random.default_rng(9)
    speeds, edges = [0.05, 0.1, 0.2, 0.3], (0.03, 0.08)

    def passed(blocks: list[Block], shift: float, play: float) -> list[Block]:
        pushed = [Crossing(e + 0.5 * play * np.sign(w), w, v) for e in edges for w in (-2, 2) for v in (-0.1, 0.1)]
        seen = [Crossing(e + shift, w, 0.2 * w) for e in edges for w in (-1, 1, -1, 1)] + pushed
        every = [tuple(replace(c, place=c.place + 1e-6 * rng.standard_normal()) for c in seen) for _ in blocks]
        return [replace(b, crossings=own) for b, own in zip(blocks, every, strict=True)]

    was = learn(passed(blocks_at(rng, speeds * 5, 3.0), 0.0, 4e-5), 0.4, 1e-6)
    assert was.turned == pytest.approx(4e-5, abs=2e-6), "what yields in normal operation"
    unsure = replace(was, own=was.own + np.diag(4.0 * (np.arange(TOTAL) // 3 == GAP // 3)))
    unsure = replace(unsure, theta=unsure.theta * (np.arange(TOTAL) != CONSTANT))
    heavy = replace(unsure, theta=unsure.theta + 30.0 * np.eye(TOTAL)[CONSTANT])
    for base, shift, play, names in (
        (unsure, 3e-4, 4e-5, ("place",)),
        (unsure, -3e-4, 4e-5, ("place",)),
        (unsure, 3e-4, 6.4e-4, ("backlash",)),
        (unsure, 3e-4, 3e-4, ("place", "backlash")),
        (replace(unsure, turned=np.nan), 3e-4, 4e-5, ("place", "backlash")),
        (heavy, 3e-4, 4e-5, ("place", "backlash")),
    ):
        seen = estimate(passed(blocks_at(rng, speeds, 3.0), shift, play), False, edges, was.scatter, was.noise, 0.4)
        found = judge(base, replace(seen, theta=seen.theta + base.theta - was.theta), 0.4)
        assert found.names == names, (shift, play, names, found.names)
        if names == ("backlash",):
            assert found.low <= play - 4e-5 <= found.high


def test_a_play_of_which_one_flank_bears_is_named_where_reversals_prove_it() -> None:
    """It shifts the reference by half of it, and a mass behind it goes on by itself when the force turns."""
    was = normal()
    for behind, names in ((1.0, ("backlash",)), (0.0, ("place",)), (0.25, ())):
        found = judge(was, now(place=3e-4, gap1=behind, gap2=0.5 * behind), 0.4)
        assert found.names == names, (behind, found.names)
        if names == ("backlash",):
            assert found.low < 6e-4 < found.high < 8e-4
    assert judge(was, now(scale=0.01, gap1=1.0), 0.4).names == ()


@pytest.mark.parametrize(
    ("back", "forth", "names"),
    [(-3e-4, 3e-4, ("backlash",)), (-6e-4, 0.0, ()), (-3.05e-4, -2.95e-4, ())],
    ids=["play", "what yields", "no edge apart"],
)
def test_edges_tell_a_play_where_no_cause_explains_the_force(back: float, forth: float, names: tuple[str, ...]) -> None:
    """A constant force on the load brings it back to its flank before the play is passed, which no column has.

    Of a play one push leaves the edge where steady speed does; what yields moves it as far one way as the other.
    """
    was = replace(normal(), turned=0.0)
    odd = now(place=-3e-4, gap2=1.7, dry=2.3, viscous=-11.5)
    assert judge(was, odd, 0.4).names == ()
    found = judge(was, replace(odd, turned=(back, forth, 5e-6)), 0.4)
    assert found.names == names
    if names:
        assert found.low < 6e-4 < found.high < 7e-4


BOTH = {"backlash", "reference hysteresis"}


def test_edges_apart_by_the_way_are_of_a_play_or_of_the_reference() -> None:
    """A play sets them apart by the push as well; its own friction may hold a load at one flank, whatever the push."""
    was, apart = replace(normal(), turned=0.0), now(play=4e-4)
    assert set(judge(was, apart, 0.4).names) == BOTH, "nothing tells them apart"
    assert judge(was, replace(apart, turned=(-2e-4, 2e-4, 1e-5)), 0.4).names == ("backlash",)
    unpushed = replace(apart, turned=(-1e-5, 1e-5, 4e-5))
    assert set(judge(was, unpushed, 0.4).names) == BOTH
    light = replace(was, theta=was.theta * (np.arange(TOTAL) != DRY))
    loose = replace(unpushed, theta=unpushed.theta * (np.arange(TOTAL) != DRY))
    assert judge(light, loose, 0.4).names == ("reference hysteresis",), "inertia would have turned a play"
    one_way = replace(apart, turned=(-2e-4, 2e-4, 1e-5), by_way=1.0)
    assert set(judge(was, one_way, 0.4).names) == BOTH, "the push is the way of the motion there"


def test_a_transmission_may_wind_up_as_far_where_its_stiffness_is_not_known() -> None:
    was = normal()
    soft = replace(was, own=was.own + np.diag(1e-8 * (np.arange(TOTAL) == GIVE)))
    assert set(judge(soft, now(play=4e-4), 0.4).names) == {*BOTH, "elasticity"}


@pytest.mark.parametrize("several", [True, False], ids=["several speeds", "one speed"])
def test_a_reference_that_is_told_late_is_known_by_the_speeds(several: bool) -> None:
    """Edges apart in proportion to the speed are told late; at one speed it could be play as well."""
    rng = np.random.default_rng(12)
    speeds, edges = [0.05, 0.1, 0.2, 0.3], (0.03, 0.08)

    def passed(blocks: list[Block], late_s: float, rates: tuple[float, ...]) -> list[Block]:
        seen = [(e + late_s * v, int(np.sign(v)), v) for e in edges for v in rates for _ in range(2)]
        return [
            replace(b, crossings=tuple(Crossing(at + 1e-6 * rng.standard_normal(), way, v) for at, way, v in seen))
            for b in blocks
        ]

    every = (-0.4, -0.2, 0.2, 0.4)
    was = learn(passed(blocks_at(rng, speeds * 5, 3.0), 2e-3, every), 0.4, 1e-6)
    later = passed(blocks_at(rng, speeds, 3.0), 5e-3, every if several else (-0.3, 0.3))
    found = judge(was, estimate(later, False, was.edges, was.scatter, was.noise, 0.4), 0.4)
    assert found.is_drift
    if several:
        assert found.names == ("late reference",) and found.low < 3e-3 < found.high < 3.5e-3
    else:
        assert {"late reference", *BOTH} <= set(found.names)
    same = passed(blocks_at(rng, speeds, 3.0), 2e-3, (-0.3, 0.3))
    assert not judge(was, estimate(same, False, was.edges, was.scatter, was.noise, 0.4), 0.4).is_drift, "as ever"


def test_a_load_that_is_now_at_one_flank_now_at_the_other_tells_the_play_by_their_distance() -> None:
    """The friction of the load is little: whichever way the axis goes, the mean edge is not that of a flank."""
    rng = np.random.default_rng(3)
    speeds, edge, gap = [0.05, 0.1, 0.2, 0.3], 0.03, 5e-4
    was = learn(referred(blocks_at(rng, speeds * 5, 3.0), rng, (edge,)), 0.4, 1e-6)
    flanks = [(-1, -0.5), (-1, -0.5), (-1, 0.5), (-1, 0.1), (1, 0.5), (1, 0.5), (1, 0.5), (1, -0.5)]
    worn = [
        replace(
            b,
            crossings=tuple(
                Crossing(edge + at * gap + 1e-6 * rng.standard_normal(), way, 0.2 * way) for way, at in flanks
            ),
        )
        for b in blocks_at(rng, speeds, 3.0)
    ]
    seen = estimate(worn, False, was.edges, was.scatter, was.noise, 0.4)
    assert abs(seen.theta[SIZE + 2]) < 0.8 * gap
    assert set(judge(was, seen, 0.4).names) > {"backlash", "reference hysteresis"}, "no push tells them apart"
    pushed = replace(seen, turned=(-0.5 * gap, 0.5 * gap, 1e-5), theta=seen.theta + 0.4 * gap * np.eye(TOTAL)[SIZE + 2])
    found = judge(replace(was, turned=0.0), pushed, 0.4)
    assert found.names == ("backlash",)
    assert found.size == pytest.approx(gap, rel=0.03) and found.low < gap < found.high


def test_what_is_normal_is_known_no_better_than_its_noise_allows() -> None:
    errors = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        known = learn(blocks_at(rng, [0.1] * 20, 3.0, noise=8.0), 0.4, 1e-6)
        errors.append((known.theta[VISCOUS] - 8.0) / np.sqrt(known.own[VISCOUS, VISCOUS]))
        assert abs(errors[-1]) < 3.0
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 1.3


def test_a_short_commissioning_has_not_seen_what_a_day_does_to_friction() -> None:
    blocks = blocks_at(np.random.default_rng(2), [0.05, 0.1, 0.2, 0.3] * 5, 3.0)
    warmer = blocks_at(np.random.default_rng(3), [0.05, 0.1, 0.2, 0.3], 2.9, 6.4)  # 20 % less viscous friction
    worn = blocks_at(np.random.default_rng(3), [0.05, 0.1, 0.2, 0.3], 3.0, 18.0)
    hour, day = (
        learn([replace(b, start_s=b.start_s * s, end_s=b.end_s * s) for b in blocks], 0.4, 1e-6) for s in (1.0, 30.0)
    )
    now_warmer, now_worn = (estimate(some, False, (), 0.0, 0.02, 0.4) for some in (warmer, worn))
    assert judge(day, now_warmer, 0.4).is_drift and not judge(hour, now_warmer, 0.4).is_drift
    assert "viscous friction" in judge(hour, now_worn, 0.4).names


def test_a_mass_is_no_scale_where_no_reference_tells_one() -> None:
    """A scale would have to be half off, and to change viscous friction as well."""
    rng, speeds = np.random.default_rng(8), [0.05, 0.1, 0.2, 0.3]
    was = learn(blocks_at(rng, speeds * 5, 3.0), 0.4, 1e-6)
    heavier = blocks_at(rng, speeds, 3.0, mass=3.0)
    assert judge(was, estimate(heavier, False, (), 0.0, was.noise, 0.4), 0.4).names == ("mass",)


def test_the_state_comes_back_and_damaged_state_is_left_out() -> None:
    watch = AxisWatch(ABOUT, Settings())
    watch.normal, watch.motion_s = normal(), 1234.5
    text = json_text(packed(watch, 1000.0))
    again = AxisWatch(ABOUT, Settings())
    assert restore(again, json_of(text), 900.0) == ""
    assert again.normal is not None and again.normal.theta == pytest.approx(watch.normal.theta)
    assert again.normal.until_s == pytest.approx(100.0), "the axis's clock began anew 100 s later"
    assert json_of(json_text(packed(again, 900.0))) == json_of(text)
    kept = json_of(text)
    for key in kept:
        for wrong in (None if key not in ("normal", "drift") else 7, "x", [1], {"theta": []}, float("inf")):
            fresh = AxisWatch(ABOUT, Settings())
            assert restore(fresh, {**kept, key: wrong}, 0.0) and fresh.normal is None
    other = AxisWatch(replace(ABOUT, travel=0.5), Settings())
    assert "another travel" in restore(other, kept, 0.0)


def test_a_margin_is_that_of_the_loop() -> None:
    rate = 2 * np.pi * 20.0
    lead = 2 * 2.0 * rate / TICK_S
    k = 2.0 * rate**2 + lead
    gains = Gains(k, -lead / k, 0.0, 0.0)
    assert 0.6 < margin(gains, 2.0, 0.0, TICK_S) < 1.0
    assert margin(gains.scaled(400.0, 20.0), 2.0, 0.0, TICK_S) == 0.0, "so stiff it is unstable"
    same = gains.scaled(2.0, 2.0)
    assert margin(same, 4.0, 0.0, TICK_S) == pytest.approx(margin(gains, 2.0, 0.0, TICK_S), rel=1e-6)


def test_frictions_come_out_of_slow_moves_that_begin_from_rest() -> None:
    """Dry friction at rest is whatever holds it: rows that reach there would make a steep viscous friction of it."""
    production = pytest.importorskip("sioms.reconcile_selftest.production", exc_type=ImportError)
    drawn = production.draw_machine(77, 0)
    body = drawn.body._replace(ripple=0.0, rise=0.0)
    sums, rng = np.zeros((SIZE + 1, SIZE + 1)), np.random.default_rng(1)
    for number in range(60):
        goals = (-1.0) ** number * 0.1 * np.array([1.0, -1.0])
        command, speed = production.smooth(*goals, (0.08, 0.15)[number // 2 % 2], 1.5)
        move = production.run(replace(drawn, body=body), body, command, speed, 0.0, rng)
        rows = rows_of(samples(move.position, move.force), TICK_S, drawn.speed, PLAYS * 2 * drawn.travel, None)
        assert rows is not None
        table = np.column_stack([rows.x, rows.y])
        sums += table.T @ table
    found = solved(sums)[0][[MASS, VISCOUS, DRY]]
    assert found == pytest.approx([body.mass, body.viscous, body.dry], rel=0.01)


@pytest.mark.parametrize(("speeds", "acceleration"), [((0.167,), 6.6), ((0.12, 0.2), 4.0)])
def test_cogging_at_a_steady_speed_is_no_friction(speeds: tuple[float, ...], acceleration: float) -> None:
    """It changes speed and force together: row by row the one seems to follow from the other."""
    production = pytest.importorskip("sioms.reconcile_selftest.production", exc_type=ImportError)
    drawn = production.draw_machine(78, 1)
    body, rng = drawn.body._replace(rise=0.0), np.random.default_rng(3)
    collector, blocks, at, number = Collector(), list[Block](), 0.0, 0
    while len(blocks) < 6:
        goal = rng.uniform(-0.27, 0.27)
        if abs(goal - at) < 0.02:
            continue
        number += 1
        command, speed = production.smooth(at, goal, speeds[number % len(speeds)], acceleration)
        move = production.run(replace(drawn, body=body), body, command, speed, 0.0, rng)
        seen = replace(samples(move.position, move.force, 5.0 * number), command=command, speed=speed)
        rows, at = rows_of(seen, TICK_S, drawn.speed, PLAYS * 2 * drawn.travel, None), goal
        block = None if rows is None else collector.add(rows)
        blocks += [] if block is None else [block]
    found = estimate(blocks, False, (), 0.0, 0.0, 2 * drawn.travel)
    off = found.theta[[MASS, VISCOUS, DRY]] - [body.mass, body.viscous, body.dry]
    assert np.all(np.abs(off) < 2.5 * np.sqrt(np.diag(found.noise)[[MASS, VISCOUS, DRY]]))


def test_the_numbers_of_a_simulated_production_come_out_and_a_weaker_drive_scales_them() -> None:
    """The generator has a plant of its own: what is drawn there is what the regression finds."""
    production = pytest.importorskip("sioms.reconcile_selftest.production", exc_type=ImportError)
    found = {}
    machine = production.draw_machine(1, 0)
    for name, each in (("new", machine), ("weak", machine.drifted("force", 0.2))):
        sums = np.zeros((SIZE + 1, SIZE + 1))
        for move in production.Day(each, 5).moves(120.0):
            n = len(move.position)
            start = move.start_s + TICK_S * np.arange(n)
            seen = Samples(
                start, move.position, move.force, move.command, move.speed, move.moving, np.ones(n, dtype=np.bool_)
            )
            rows = rows_of(seen, TICK_S, machine.speed, PLAYS * 2 * machine.travel, None)
            if rows is not None:
                table = np.column_stack([rows.x, rows.y])
                sums += table.T @ table
        found[name] = solved(sums)[0][[MASS, DRY, CONSTANT]]
    body = machine.body
    assert found["new"] == pytest.approx([body.mass, body.dry, -body.constant], rel=0.15)
    assert found["weak"] == pytest.approx(found["new"] / 0.8, rel=0.03)
