"""What is stated of another machine's clock, beside the truth: the estimator alone, on clocks and links that are
simulated, so that the truth is known and no processor's turn matters.

A trial is a session of up to a minute, with exchanges as often as a client makes them. Each direction of its link has
a delay of its own (20 us to 50 ms) with a tail and bursts; the clocks part by up to 100 ppm, which changes in time. In
one trial of ten a clock jumps once, as that of a machine that is suspended. The truth is compared at a random instant.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from contextlib import suppress

from sioms.client.remote import FIRST_PINGS
from sioms.protocol.clock import Offset
from sioms.protocol.link import PING_S

from .figures import Bar, Report
from .options import Options

JUMPS = 0.1
"""Share of the trials in which a clock jumps."""
LONGEST_S = 60.0


def bench_clocks(options: Options, report: Report) -> None:
    """Compare what is stated with the truth, in many trials."""
    for what, jumps in (("clocks that drift", 0.0), ("clocks that drift, one in ten jumps", JUMPS)):
        chance, errors, offs, wrong = random.Random(options.seed), [], [], 0
        count = options.kills(2_000, 10_000)
        for _ in range(count):
            off_ns, error_ns = trial(chance, jumps)
            errors.append(error_ns)
            offs.append(off_ns)
            wrong += off_ns > error_ns
        report.samples(f"{what}: stated error", errors)
        report.samples(f"{what}: true error", offs)
        report.value(f"{what}: trials in which it was larger than stated [%]", 100 * wrong / count,
                     bars=[Bar("value", 1.0)], notes=f"{wrong} of {count}")  # fmt: skip


def trial(chance: random.Random, jumps: float) -> tuple[int, int]:
    """Return how wrong an estimate was, and how wrong it said it might be [ns].

    Args:
        chance: of random numbers.
        jumps: probability that a clock jumps.
    """
    there = far_clock(chance, jumps)
    up, down = _way(chance), _way(chance)
    offset = Offset()
    end_s, back_s = chance.random() * LONGEST_S, 0.0
    for due_s in _instants(chance, end_s):
        sent_s = max(due_s, back_s)  # a client has one exchange under way at a time
        got_s = sent_s + up()
        answered_s = got_s + 1e-5 + chance.expovariate(1e4)
        back_s = answered_s + down()
        if back_s > end_s and offset.known:
            break
        end_s = max(end_s, back_s)
        with suppress(ValueError):  # a clock has jumped back while it was under way
            offset.exchange(_ns(sent_s), there(got_s), there(answered_s), _ns(back_s))
    now_ns = _ns(end_s)
    return abs(there(end_s) - now_ns - offset.ns), offset.error_ns(now_ns)


def far_clock(chance: random.Random, jumps: float) -> Callable[[float], int]:
    """Return what a clock there shows at an instant here [s to ns]: up to 100 ppm fast, slowly changing."""
    begin_s = chance.uniform(-1e5, 1e5)
    rate, swing = chance.uniform(-5e-5, 5e-5), chance.uniform(0.0, 5e-5)
    omega, phase = 2 * math.pi / chance.uniform(5.0, 500.0), chance.uniform(0.0, 2 * math.pi)
    jump_at = chance.random() * LONGEST_S if chance.random() < jumps else math.inf
    jump_s = math.copysign(10 ** chance.uniform(-5.0, 1.0), chance.random() - 0.5)

    def there(here_s: float) -> int:
        drift_s = rate * here_s + swing / omega * (math.sin(omega * here_s + phase) - math.sin(phase))
        return _ns(begin_s) + _ns(here_s + drift_s + (jump_s if here_s >= jump_at else 0.0))

    return there


def _way(chance: random.Random) -> Callable[[], float]:
    """Return one direction of a link: how long each message takes [s]."""
    shortest = 10 ** chance.uniform(-4.7, -1.3)
    tail = shortest * chance.choice((0.05, 0.5, 5.0))
    burst = 0

    def delay() -> float:
        nonlocal burst
        if burst == 0 and chance.random() < 0.02:
            burst = chance.randint(1, 20)
        burst = max(0, burst - 1)
        return shortest + chance.expovariate(1.0 / tail) * (20.0 if burst else 1.0)

    return delay


def _instants(chance: random.Random, end_s: float) -> Iterator[float]:
    """Yield when a client asks for the time [s]: often at first, then regularly."""
    at = 0.0
    for _ in range(FIRST_PINGS):
        yield at
        at += 2e-3
    while at < end_s:
        yield at
        at += PING_S * (1.0 + 0.2 * chance.random())


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
