"""The clock fit against clocks whose truth is known."""

import random

import pytest

from sioms.sdk.codec.clock_fit import ClockFit

MS = 1_000_000


def run(drift: float, seconds: float, start_us: int = 0, burst_ms: float = 0.0) -> tuple[ClockFit, list[float]]:
    """Feed 200 stamps a second with random delays; return the errors of the last half [ns].

    Truth: host = 5e12 + device * (1 + drift); least delay 0.2 ms, exponential tail of 2 ms.
    """
    chance = random.Random(1)
    fit, errors, last = ClockFit(), [], 0
    arrival = 0
    for i in range(int(seconds * 200)):
        device_ns = i * 5 * MS
        truth = 5_000_000_000_000 + round(device_ns * (1 + drift))
        delay = 0.2 * MS + chance.expovariate(1 / (2 * MS))
        arrival = max(arrival, round(truth + delay))
        if burst_ms:
            arrival += -arrival % round(burst_ms * MS)
        stamp = fit.to_host((start_us + device_ns // 1000) % (1 << 32), arrival)
        assert last <= stamp <= arrival
        last = stamp
        if i > seconds * 100:
            errors.append(stamp - truth)
    return fit, errors


@pytest.mark.parametrize("drift", [0.0, 50e-6, -50e-6, 0.005, -0.005])
def test_error_stays_near_the_least_delay(drift: float) -> None:
    fit, errors = run(drift, 30)
    assert max(errors) < 0.5 * MS and min(errors) > -0.3 * MS
    assert fit.drift == pytest.approx(drift, abs=40e-6)
    assert fit.restarts == 0


def test_bursts_of_an_adapter_that_holds_bytes_16_ms() -> None:
    _, errors = run(50e-6, 30, burst_ms=16)
    assert max(errors) < 3 * MS and min(errors) > -3 * MS


def test_wrap_of_the_counter() -> None:
    fit, errors = run(50e-6, 20, start_us=(1 << 32) - 15_000_000)
    assert max(map(abs, errors)) < 0.5 * MS
    assert fit.restarts == 0


def test_a_gap_longer_than_the_counter() -> None:
    fit = ClockFit()
    fit.to_host(1000, 10**12)
    gap_us = 2 * (1 << 32) + 7_000_000
    now = 10**12 + gap_us * 1000 + 5 * MS
    assert fit.to_host((1000 + gap_us) % (1 << 32), now) == now - 5 * MS
    assert fit.restarts == 0


def test_a_stall_is_no_restart_and_its_samples_keep_their_times() -> None:
    fit = ClockFit()
    for i in range(1000):
        fit.to_host(i * 1000, 10**12 + i * MS)
    stamps = [fit.to_host((1000 + i) * 1000, 10**12 + 3000 * MS) for i in range(2000)]
    assert stamps[0] == 10**12 + 1000 * MS
    assert stamps[-1] == 10**12 + 2999 * MS
    assert fit.restarts == 0


def test_a_restarted_device_begins_a_new_fit() -> None:
    fit = ClockFit()
    for i in range(1000):
        fit.to_host(40_000_000 + i * 1000, 10**12 + i * MS)
    later = 10**12 + 2000 * MS
    assert fit.to_host(1000, later) == later
    assert fit.restarts == 1
    assert fit.to_host(2000, later + 2 * MS) == later + 1 * MS


# --- a rate that is not the stated one ------------------------------------------------------------


def misstated(
    ratio: float, seconds: float, hz: float = 500.0, jitter_ms: float = 1.0, stalls: bool = False, after_s: float = 0.0
) -> tuple[ClockFit, list[tuple[float, float]]]:  # fmt: skip
    """Feed stamps of a clock whose counts last ``ratio`` times the stated microsecond; return (second, error in ms) of
    each.

    Args:
        ratio: real duration of a count over the stated one.
        seconds: length of the record.
        hz: samples a second.
        jitter_ms: mean of the exponential delays.
        stalls: every 1.7 s the host is held up for 0.3 s and gets what came in one go.
        after_s: the rate is right until then.
    """
    chance = random.Random(2)
    fit, errors = ClockFit(), []
    arrival, counted_us = 0, 0.0
    for i in range(int(seconds * hz)):
        at_s = i / hz
        counted_us += 1e6 / hz / (ratio if at_s >= after_s else 1.0)
        truth = 10**12 + round(at_s * 1e9)
        delay = chance.expovariate(1 / (jitter_ms * MS))
        if stalls and at_s % 1.7 > 1.4:
            delay += (1.7 - at_s % 1.7) * 1e9
        arrival = max(arrival, round(truth + delay))
        stamp = fit.to_host(round(counted_us), arrival)
        assert stamp <= arrival
        errors.append((at_s, (stamp - truth) / MS))
    return fit, errors


@pytest.mark.parametrize("ratio", [7000 / 976, 7000 / 4000, 1.1, 1.02, 0.98, 0.9, 0.5, 0.1, 7000 / 20000])
@pytest.mark.parametrize("hz", [20.0, 500.0])
def test_no_stamp_of_a_misstated_rate_is_far_off_and_soon_none_is(ratio: float, hz: float) -> None:
    """Stated 7000, counted 976: no stamp may be seconds wrong for seconds, and after a second all are right."""
    fit, errors = misstated(ratio, 12.0, hz)
    assert max(abs(error) for _, error in errors) < 60
    assert max(abs(error) for at_s, error in errors if at_s > 2.5) < 12
    assert max(abs(error) for at_s, error in errors if at_s > 8) < 5
    assert fit.drift == pytest.approx(ratio - 1, abs=2e-3 * ratio)
    assert fit.restarts == 0 and fit.uncertainty_ns < 10 * MS


@pytest.mark.parametrize("ratio", [7000 / 976, 1.1, 0.5])
def test_a_misstated_rate_on_a_host_that_is_held_up(ratio: float) -> None:
    """Samples that waited for the host 0.3 s long count as measured when they were measured, once the rate is known."""
    _, errors = misstated(ratio, 20.0, stalls=True)
    assert max(abs(error) for _, error in errors) < 310, "while nothing is known, the delay itself"
    assert max(abs(error) for at_s, error in errors if at_s > 4) < 15


@pytest.mark.parametrize("ratio", [3.0, 1.3, 0.8])
def test_a_rate_that_changes_in_the_middle(ratio: float) -> None:
    """Somebody sets the device to another rate: bounded, and right again within two seconds."""
    fit, errors = misstated(ratio, 16.0, after_s=6.0)
    assert max(abs(error) for _, error in errors) < 160
    assert max(abs(error) for at_s, error in errors if at_s > 10) < 60
    assert max(abs(error) for at_s, error in errors if at_s > 14) < 12
    assert fit.restarts <= (ratio < 1)


def test_the_uncertainty_is_told() -> None:
    fit = ClockFit()
    fit.to_host(0, 10**12)
    assert fit.uncertainty_ns == 50 * MS and not fit.is_measured
    fit, _ = misstated(1.0, 10.0, jitter_ms=0.2)
    assert fit.is_measured and fit.uncertainty_ns < 1 * MS and fit.rate_error == 0
