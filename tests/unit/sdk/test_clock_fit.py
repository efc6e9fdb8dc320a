"""The clock fit against clocks whose truth is known."""

import random

import pytest

from sioms.sdk.codec.clock_fit import ClockFit

MS = 1_000_000


def run(
    drift: float, seconds: float, start_us: int = 0, burst_ms: float = 0.0
) -> tuple[ClockFit, list[float]]:
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
