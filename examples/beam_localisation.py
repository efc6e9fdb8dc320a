"""Locate a light beam with a moving axis: correlate edges with positions by their time stamps.

Neither latency nor speed matters: the edge carries the instant at which it happened, the page of the
axis keeps the positions of the recent past, and the position at the edge is interpolated between them.
"""

from itertools import pairwise

import sioms


def position_at(axis: sioms.AxisNode, stamp_ns: int) -> float:
    """Return the axis' position at an instant of the recent past."""
    past = axis.history(after=0)
    for before, after in pairwise(past):
        if before.stamp_ns <= stamp_ns <= after.stamp_ns:
            share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
            return before.position[0] + share * (after.position[0] - before.position[0])
    raise LookupError("the edge is older than what the page keeps; enlarge history in the configuration")


def main() -> None:
    with sioms.Workcell() as cell, cell.open("mod0.xaxis", "rw") as axis, cell.open("beam0") as beam:
        axis.move(0.05)
        axis.wait_until_idle(timeout=5.0)
        edge = beam.read()
        axis.move(0.20)
        places = []
        for _ in range(2):  # into the beam, and out of it
            edge = beam.wait_event(last=edge, timeout=5.0)
            axis.wait_new(axis.read().number, timeout=1.0)
            places.append(position_at(axis, edge.stamp_ns))
        axis.wait_until_idle(timeout=5.0)
        print(f"beam 0 from {places[0] * 1e3:.3f} to {places[1] * 1e3:.3f} mm")


if __name__ == "__main__":
    main()
