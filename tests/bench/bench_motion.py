"""Cost of the motion core: ticks by number of axes, a synch of a thousand axes, appending commands.

Run: python tests/bench/bench_motion.py. Reports percentiles; asserts nothing.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from sioms.motion import AxisBank, AxisSettings
from sioms.motion.commands import WIRE_DTYPE
from sioms.protocol.flags import ControlMode as M


class NoMarkers:
    """A marker port for commands that name no marker."""

    def capture(self, token_or_number: int, *, signal: bool) -> tuple[int, int]:
        """Return the number as it is."""
        return token_or_number, 1

    def state(self, number: int, generation: int) -> bool | None:
        """Tell that nothing is signalled."""
        return False

    def signal(self, number: int, generation: int, now_ns: int) -> None:
        """Drop the signal."""


def bank_of(n: int, tick_s: float = 1e-3) -> AxisBank:
    """Return a bank of n servo axes."""
    settings = AxisSettings(
        name="x",
        velocity_max=1.0,
        acceleration_max=10.0,
        jerk_max=200.0,
        position_min=-5.0,
        position_max=5.0,
        force_max=50.0,
        k=400.0,
        kz=-0.5,
        kp=0.1,
        kb=-5.0,
        following_error_max=0.5,
        velocity_filter_s=2e-3,
    )
    return AxisBank([settings] * n, tick_s=tick_s, markers=NoMarkers())


def report(what: str, samples_ns: list[int]) -> None:
    """Print percentiles in microseconds."""
    p = np.percentile(np.array(samples_ns) * 1e-3, [50, 99, 100])
    print(f"{what:58} median {p[0]:9.1f}  p99 {p[1]:9.1f}  max {p[2]:9.1f} us")


def timed(call: Callable[..., object], *arguments: Any) -> int:
    """Return the duration of a call [ns]."""
    begin = time.perf_counter_ns()
    call(*arguments)
    return time.perf_counter_ns() - begin


def run(n: int, tick_s: float, ticks: int, moves: int) -> None:
    """Tick a bank whose axes each carry out random moves of about a second, and follow it exactly."""
    rng = np.random.default_rng(1)
    bank, axes, now = bank_of(n, tick_s), np.arange(n), 10**9
    step = round(tick_s * 1e9)
    position = np.zeros(n)
    bank.tick(now, position)
    records = np.zeros(n * moves, dtype=WIRE_DTYPE)
    records["axis"] = np.tile(axes, moves)
    records["control_mode"] = int(M.POSITION)
    records["position"] = rng.uniform(-0.4, 0.4, n * moves)
    bank.append(records, axes, now)
    ticks_ns, slack_ns = [], []
    page = np.zeros_like(bank.fields)
    for _ in range(ticks):
        now += step
        ticks_ns.append(timed(bank.tick, now, position))
        slack_ns.append(timed(bank.plan_ahead, 32))
        np.copyto(page, bank.fields)
        np.copyto(position, bank.rows["commanded_position"])
    report(f"tick, {n} axes at {1 / tick_s:.0f} Hz, random moves", ticks_ns)
    report("  plan_ahead(32) after it", slack_ns)


def synch_thousand(n: int = 1000) -> None:
    """Start n axes by one synch."""
    bank, axes, now = bank_of(n), np.arange(n), 10**9
    position = np.zeros(n)
    bank.tick(now, position)
    records = np.zeros(n, dtype=WIRE_DTYPE)
    records["axis"] = axes
    records["control_mode"] = int(M.POSITION | M.WAIT_FOR_EXTERNAL_SYNCH)
    records["position"] = 0.3
    print(f"append 1 command to each of {n} axes: {timed(bank.append, records, axes, now) * 1e-6:.2f} ms")
    print(f"plan them ahead: {timed(bank.plan_ahead, n) * 1e-6:.2f} ms")
    now += 10**6
    bank.tick(now, position)
    print(f"synch call: {timed(bank.synch, axes, now + 2_000_000, now) * 1e-6:.3f} ms")
    samples = []
    for _ in range(5):
        now += 10**6
        samples.append(timed(bank.tick, now, position))
    print(f"ticks around the start of {n} axes [us]:", [round(s * 1e-3) for s in samples])
    print(f"emergency stop of {n} moving axes: {timed(bank.emergency_stop, axes, now) * 1e-6:.3f} ms")


def append_many(count: int = 10_000) -> None:
    """Append many commands at once."""
    for mode, what in (
        (M.POSITION, "positions"),
        (M.POSITION | M.VELOCITY | M.SPECIFIED_TIME, "timed passes"),
    ):
        bank, now = bank_of(4), 10**9
        bank.tick(now, np.zeros(4))
        records = np.zeros(count, dtype=WIRE_DTYPE)
        i = np.arange(count) // 4
        records["axis"] = np.arange(count) % 4
        records["control_mode"] = int(mode)
        records["time"] = 0.01
        w = 2 * np.pi * 0.5
        records["position"] = 0.1 * (1 - np.cos(w * 0.01 * (i + 1)))
        records["velocity"] = 0.1 * w * np.sin(w * 0.01 * (i + 1))
        cost = timed(bank.append, records, [0, 1, 2, 3], now)
        print(f"append {count} {what}: {cost * 1e-6:.2f} ms")


def main() -> None:
    """Run all benches."""
    gc.disable()
    for n, tick_s, ticks in (
        (1, 1e-3, 4000),
        (4, 1e-3, 4000),
        (16, 1e-3, 4000),
        (90, 1e-3, 3000),
        (200, 2e-4, 8000),
        (1000, 1e-3, 2000),
        (2000, 1e-3, 2000),
    ):
        run(n, tick_s, ticks, 12)
    synch_thousand()
    append_many()


if __name__ == "__main__":
    main()
