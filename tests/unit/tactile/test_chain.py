"""The signal chain follows drift, keeps touches, undoes the quadratic and drops bad elements."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from sioms.tactile.chain import DEAD_FRAMES, RECOVER_S, SETTLE_FRAMES, SignalChain
from sioms.tactile.finger import Finger

PERIOD_NS = 8_333_333


@pytest.fixture
def finger(nominal: Finger) -> Finger:
    elements = msgspec.structs.replace(nominal.elements, gain=(3.0,) * 16, quadratic=(4.0,) * 16, noise=(5e-4,) * 16)
    return msgspec.structs.replace(nominal, elements=elements)


class Bench:
    """Feed a chain with noisy frames at 120 Hz; raw units are per cent."""

    def __init__(self, finger: Finger) -> None:
        self.chain, self.stamp_ns = SignalChain(finger), 0
        self.random = np.random.default_rng(11)
        self.offset = np.linspace(-2.0, 3.0, 16)
        # an edge right over each element moves its neighbours, too
        table = finger.strain_table()
        places = np.round((np.array(finger.angles_rad) - table.first) / table.step).astype(int)
        felt = table.nodes[0, places, 0]
        self.pattern = felt / np.diag(felt)[:, None]

    def feed(self, frames: int, output: float = 0.0, element: int = 8, drift_per_s: float = 0.0):  # type: ignore[no-untyped-def]
        out = None
        for _ in range(frames):
            self.stamp_ns += PERIOD_NS
            self.offset = self.offset + drift_per_s * PERIOD_NS * 1e-9
            raw = self.offset + 0.05 * self.random.normal(size=16)
            raw += output * self.pattern[element]
            out = self.chain.frame(raw, self.stamp_ns)
        return out


def test_strain_of_a_touch(finger: Finger) -> None:
    bench = Bench(finger)
    assert not bench.feed(1).settled
    bench.feed(SETTLE_FRAMES)
    free = bench.feed(200)
    assert free.settled
    assert not free.touched
    assert free.strength == pytest.approx(1.0, abs=1.0)
    linear = 0.05
    touched = [bench.feed(1, 100 * (linear + 4.0 * linear**2)) for _ in range(100)]
    assert all(frame.touched for frame in touched)
    assert np.mean([frame.strains[8] for frame in touched]) == pytest.approx(-3.0 * linear, rel=0.02)
    assert np.mean([frame.strains[2] for frame in touched]) == pytest.approx(
        -3.0 * linear * bench.pattern[8][2], abs=1e-3
    )
    assert not bench.feed(5).touched


def test_drift_is_followed_untouched_and_kept_out_of_touches(finger: Finger) -> None:
    bench = Bench(finger)
    bench.feed(200)
    frame = bench.feed(1200, drift_per_s=0.02)
    assert not frame.touched
    lag = bench.offset.mean() - bench.chain.baseline.mean()
    assert lag == pytest.approx(0.02 * finger.signal.drift_time_s, rel=0.5)  # first-order follower
    before = bench.chain.baseline
    bench.feed(600, output=5.0, drift_per_s=0.005)
    assert bench.chain.baseline == pytest.approx(before)
    bench.feed(10)  # after the release the others catch up with their drift, the element that was touched hardly
    moved = (bench.chain.baseline - before) / (bench.offset - before)
    assert np.mean(np.delete(moved, 8)) > 0.5 and moved[8] < 0.2
    bench.feed(1200)
    assert bench.chain.baseline == pytest.approx(bench.offset, abs=0.02)


@pytest.mark.parametrize("drift_per_s", [0.0, 0.02])
def test_touches_in_quick_succession_let_the_baseline_follow_but_take_no_creep(
    finger: Finger, drift_per_s: float
) -> None:
    """Forty seconds of touches half a second long and 0.3 s apart; a tenth of each output fades in 0.25 s."""
    bench, random = Bench(finger), np.random.default_rng(5)
    bench.feed(200)
    for _ in range(50):
        element = int(random.integers(16))
        bench.feed(60, output=8.0, element=element, drift_per_s=drift_per_s)
        for late in range(36):
            bench.feed(1, output=0.8 * np.exp(-late / 30.0), element=element, drift_per_s=drift_per_s)
    off = bench.chain.baseline - bench.offset
    assert np.sqrt(np.mean(off**2)) < 0.05  # the noise of a frame; the drift was 0.8 % in all
    assert np.abs(off).max() < 0.12


def test_zero_takes_a_new_baseline(finger: Finger) -> None:
    bench = Bench(finger)
    bench.feed(100)
    bench.offset += 4.0 * bench.pattern[3]
    assert bench.feed(5).touched
    bench.chain.zero()
    assert not bench.feed(SETTLE_FRAMES).settled
    frame = bench.feed(1)
    assert frame.settled
    assert not frame.touched
    assert bench.chain.baseline == pytest.approx(bench.offset, abs=0.06)


def test_what_moves_all_elements_alike_is_no_touch(finger: Finger) -> None:
    bench = Bench(finger)
    bench.feed(200)
    bench.offset += 1.0  # a gust of warm air
    assert not bench.feed(1).touched
    bench.feed(1200)
    assert bench.chain.baseline == pytest.approx(bench.offset, abs=0.02)


def test_bad_elements_are_marked(finger: Finger) -> None:
    bench = Bench(finger)
    bench.feed(100)
    for _ in range(DEAD_FRAMES + 1):
        bench.stamp_ns += PERIOD_NS
        raw = bench.offset + 0.05 * bench.random.normal(size=16)
        raw[4], raw[9], raw[14] = 1.0, np.nan, 100.0
        frame = bench.chain.frame(raw, bench.stamp_ns)
    assert frame.dead.tolist() == [n in (4, 14) for n in range(16)]
    assert frame.saturated.tolist() == [n == 14 for n in range(16)]
    assert frame.usable.tolist() == [n not in (4, 9, 14) for n in range(16)]
    assert np.isnan(frame.strains[[4, 9, 14]]).all()
    assert not frame.touched
    # they move again: two at once, the one that seemed to move alone after a while
    assert bench.feed(1).usable.tolist() == [n != 4 for n in range(16)]
    assert bench.feed(round((RECOVER_S + 0.1) * 1e9 / PERIOD_NS)).usable.all()


def test_gains_are_replaced(finger: Finger) -> None:
    bench = Bench(finger)
    bench.feed(100)
    bench.chain.set_gain(np.full(16, 6.0))
    assert np.mean([bench.feed(1, 1.0).strains[8] for _ in range(50)]) == pytest.approx(-6.0 * 0.00963, rel=0.05)
    for bad in (np.ones(3), np.zeros(16), np.full(16, np.nan)):
        with pytest.raises(ValueError, match="set gain"):
            bench.chain.set_gain(bad)


def test_bad_frames_are_refused(finger: Finger) -> None:
    chain = SignalChain(finger)
    with pytest.raises(ValueError, match=r"17 readings in shape \(17,\); the finger has 16 elements"):
        chain.frame(np.zeros(17), 0)
    chain.frame(np.zeros(16), 10)
    with pytest.raises(ValueError, match="stamp 9 ns is before the last one, 10 ns"):
        chain.frame(np.zeros(16), 9)
