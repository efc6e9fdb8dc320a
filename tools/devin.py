"""devin: read devices and print their state (dissertation, section F.4.1).

Decisions where the text leaves a choice are in docs/pipe-tools.md.
"""

from __future__ import annotations

import os
from time import monotonic_ns, sleep

from sioms.client.workcell import Workcell

from .options import Line, UsageError, fold
from .pipe import complain, open_node, run, write_all
from .rows import Rows

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Any

DEFAULT_COUNT = 100
LOOK_S = 0.01
"""How often a recording looks for new readings [s]; the page keeps more than come meanwhile."""


def main(words: Sequence[str] | None = None) -> int:
    """Run devin; return the exit status."""
    return run("devin", _work, words)


def _work(words: Sequence[str]) -> None:
    line = fold("devin", words)
    timed = any(key in line.common for key in "rtL")
    if line.numbers:
        raise UsageError(f"{line.numbers[0]}: devin takes no numbers; write an option's number right after its letter")
    if not line.targets:
        raise UsageError("no device given; try --help")
    _check_trailing(line, timed)
    digits = int(line.common["digits"]) if "digits" in line.common else None
    cell = Workcell(name="devin")
    # A reader never stands in anybody's way: it takes the read-only companion of an output.
    nodes = [open_node(cell, target.name, "r", companion=True) for target in line.targets]
    if "record" in line.common:
        _record(line, nodes)
        return
    rows = [Rows(t, n.info, timed, digits) for t, n in zip(line.targets, nodes, strict=True)]
    pairs = list(zip(rows, nodes, strict=True))

    def sample() -> str:
        return "".join([row.text(node.read()) for row, node in pairs])

    if not timed:
        write_all(sample().encode())
        return
    numbered = "N" in line.trailing or any("N" in target.flags for target in line.targets)
    repeat(sample, line.common.get("t", 1.0), int(line.common.get("L", DEFAULT_COUNT)), numbered)


def _record(line: Line, nodes: Sequence[Any]) -> None:
    """Print a table of readings, each once, with the stamps that the driver gave them."""
    from .recording import Table

    if len(nodes) != 1:
        raise UsageError("--record takes one device, as several have different timestamps; run one devin for each")
    target, node = line.targets[0], nodes[0]
    other = [key for key in target.flags if key not in "lhn"]
    if other:
        raise UsageError(f"-{other[0]}: --record prints everything; choose structures by -l, -h and -n")
    digits = int(line.common["digits"]) if "digits" in line.common else None
    table = Table(node.info, target.channels(len(node.info.channels)), digits)
    count, period_s = int(line.common.get("L", DEFAULT_COUNT)), line.common.get("t", 0.0)
    write_all(table.head.encode())
    seen = node.read().number
    printed = lost = 0
    due_ns = monotonic_ns()
    while printed != count:
        fresh = node.history(seen)
        if fresh and seen:
            lost += fresh[0].number - seen - 1
        if period_s and fresh:
            del fresh[:-1]
        if fresh:
            seen = fresh[-1].number
            del fresh[count - printed if count >= 0 else len(fresh) :]
            write_all("".join([table.row(snapshot) for snapshot in fresh]).encode())
            printed += len(fresh)
        due_ns = max(due_ns + int((period_s or LOOK_S) * 1e9), monotonic_ns() - 1)
        if printed != count:
            sleep(max(0.0, (due_ns - monotonic_ns()) / 1e9))
    if lost and not period_s:
        complain(
            "devin",
            f"{lost} readings are missing from the table: they were overwritten before they were read",
            0,
        )


def _check_trailing(line: Line, timed: bool) -> None:
    lost = [key for key in line.trailing if not (key == "N" and timed)]
    if lost:
        raise UsageError(f"-{lost[0]} applies to the device that follows it, and none follows")


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
