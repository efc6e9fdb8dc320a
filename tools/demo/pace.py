"""How fast the demo's devices tick, and how long they may be silent: what this machine, with all that it has to do,
can carry.

A simulated drive that gets less of a processor than its ticks take falls behind further and further, and answers
nobody. At a lower rate the same motions are shown, a little less exactly. A simulated board that waits for a processor
replies late; a configuration for real ones takes that for a broken cable, and stops.
"""

from __future__ import annotations

import re
import time

LOOK_S = 0.5
RATES = ((0.4, 1000.0), (0.2, 500.0), (0.0, 200.0))
"""Least share of a processor, and the rate that it carries [Hz]; an axis device takes a fifth of one at 1000 Hz."""
SLOW_HZ, SLOW_BANDWIDTH_HZ = 500.0, 12.0
"""Below this rate the servos' usual bandwidth is too much, and this is what they get."""


PATIENCE = {
    r"^(\[workcell\])$": "daemon_lease_s = 30.0",
    r"^(driver = .*)$": "lease_s = 30.0",
    r"^(model = .*|address = .*)$": "override = { turnaround_s = 1.0 }",
}
"""Where nothing real moves, silence may last: lines of a configuration, and what is written below each."""


def share() -> float:
    """Return how much of a processor a process gets that wants all of it, 0 to 1."""
    began_s, used_s = time.perf_counter(), time.process_time()
    while (wall_s := time.perf_counter() - began_s) < LOOK_S:
        pass
    return (time.process_time() - used_s) / wall_s


def rate_for(share_: float) -> float:
    """Return the rate of the ticks that goes with a share of a processor [Hz]."""
    return next(rate for least, rate in RATES if share_ >= least)


def paced(config: str, rate_hz: float) -> str:
    """Return the configuration with all devices but the tactile array, which is slow, at a rate."""
    text = re.sub(r'^(driver = "sim-(?:axes|force|io)")$', rf"\1\ntick_hz = {rate_hz:.1f}", config, flags=re.MULTILINE)
    if rate_hz < SLOW_HZ:
        text = re.sub(r"^(motor = )", rf"bandwidth_hz = {SLOW_BANDWIDTH_HZ:.1f}\n\1", text, flags=re.MULTILINE)
    return text


def patient(config: str) -> str:
    """Return a configuration whose simulated devices may be silent for longer than real ones would be allowed to."""
    for line, below in PATIENCE.items():
        config = re.sub(line, rf"\1\n{below}", config, flags=re.MULTILINE)
    return config
