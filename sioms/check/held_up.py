"""Whether the machine held up what a trial needs: then its failure says nothing about the driver.

A real device waits for nobody. A simulated one, the wire to it, the driver and its daemon are processes; where the
system allows them no real-time priority, a busy machine may leave any of them without a processor for longer than a
device may be silent. The kernel counts how long each process was ready to run and did not.
"""

from __future__ import annotations

from collections.abc import Mapping

HELD_UP_S = 0.25
"""A process that waited for a processor as long as this in all during a trial was held up [s]: half of the time after
which a device counts as silent (``LineUnit.silence_s``) and a driver as hung (its lease)."""


class Waits:
    """How long processes wait for a processor from now on.

    Args:
        processes: their ids, by what they are.
    """

    def __init__(self, processes: Mapping[str, int]) -> None:
        self._before = {pid: waited_ns(pid) for pid in processes.values()}

    def longest(self, processes: Mapping[str, int]) -> str:
        """Return which process was held up the longest, and how long, in words; '' when none was.

        Args:
            processes: those of now; one that is new has waited since it began.
        """
        waits = {what: (waited_ns(pid) - self._before.get(pid, 0)) / 1e9 for what, pid in processes.items()}
        what = max(waits, key=waits.__getitem__, default="")
        if not what or waits[what] < HELD_UP_S:
            return ""
        return f"{what} waited {waits[what]:.1f} s for a processor"


def tree_waited_ns(pid: int) -> int:
    """Return the longest time that a process or one of its descendants has been ready to run without running [ns]."""
    try:
        with open(f"/proc/{pid}/task/{pid}/children", encoding="ascii") as file:
            children = [int(word) for word in file.read().split()]
    except (OSError, ValueError):  # it has ended, or the kernel does not tell
        children = []
    return max([waited_ns(pid), *map(tree_waited_ns, children)])


def waited_ns(pid: int) -> int:
    """Return how long a process has been ready to run without running [ns]; 0 where that is not known."""
    try:
        with open(f"/proc/{pid}/schedstat", encoding="ascii") as file:
            return int(file.read().split()[1])
    except (OSError, IndexError, ValueError):  # it has ended, or the kernel does not count
        return 0
