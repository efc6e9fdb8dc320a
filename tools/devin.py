"""devin: read devices and print their state (dissertation, section F.4.1).

Decisions where the text leaves a choice are in docs/pipe-tools.md.
"""

from __future__ import annotations

import os
from time import monotonic_ns, sleep

from sioms.client.workcell import Workcell

from .options import Line, UsageError, fold
from .pipe import open_node, run, write_all
from .rows import Rows

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

DEFAULT_COUNT = 100


def main(words: Sequence[str] | None = None) -> int:
    """Run devin; return the exit status."""
    return run("devin", _work, words)


def _work(words: Sequence[str]) -> None:
    line = fold("devin", words)
    timed = any(key in line.common for key in "rtL")
    if line.numbers:
        raise UsageError(
            f"{line.numbers[0]}: devin takes no numbers; an option's number stands right behind it"
        )
    if not line.targets:
        raise UsageError("no device named; try --help")
    _check_trailing(line, timed)
    digits = int(line.common["digits"]) if "digits" in line.common else None
    cell = Workcell(name="devin")
    # A reader never stands in anybody's way: it takes the read-only companion of an output.
    nodes = [open_node(cell, target.name, "r", companion=True) for target in line.targets]
    rows = [Rows(t, n.info, timed, digits) for t, n in zip(line.targets, nodes, strict=True)]
    pairs = list(zip(rows, nodes, strict=True))

    def sample() -> str:
        return "".join([row.text(node.read()) for row, node in pairs])

    if not timed:
        write_all(sample().encode())
        return
    numbered = "N" in line.trailing or any("N" in target.flags for target in line.targets)
    repeat(sample, line.common.get("t", 1.0), int(line.common.get("L", DEFAULT_COUNT)), numbered)


def _check_trailing(line: Line, timed: bool) -> None:
    lost = [key for key in line.trailing if not (key == "N" and timed)]
    if lost:
        raise UsageError(f"-{lost[0]} holds for the device that follows it, and none follows")


def repeat(sample: Callable[[], str], period_s: float, count: int, numbered: bool) -> None:
    """Print samples on an absolute schedule: sample k is taken k periods after the first, without drift.

    A sample whose time has passed when its turn comes is left out, its number with it: behind a slow
    reader old rows would never again catch up with the present.

    Args:
        sample: gives the text of one sample.
        period_s: [s].
        count: how many; -1: no end.
        numbered: begin each line with the time since the first sample [s] and the sample's number.
    """
    _sharpen_timer()
    period_ns = max(1, round(period_s * 1e9))
    start_ns = monotonic_ns()
    number = printed = 0
    while printed != count:
        now_ns = monotonic_ns()
        text = sample()
        if numbered:
            text = f"{(now_ns - start_ns) / 1e9:.6f} {number} {text.rstrip()}\n"
        write_all(text.encode())
        printed += 1
        number = max(number + 1, (monotonic_ns() - start_ns) // period_ns)
        if printed != count:
            late_ns = start_ns + number * period_ns - monotonic_ns()
            if late_ns > 0:
                sleep(late_ns / 1e9)


def _sharpen_timer() -> None:
    """Have the kernel wake us on time, not up to 50 us later to save power."""
    try:
        fd = os.open("/proc/self/timerslack_ns", os.O_WRONLY)
        os.write(fd, b"1")
        os.close(fd)
    except OSError:
        pass  # an older or a locked kernel: wakes a little later
