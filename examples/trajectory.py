"""A circle of 200 pieces, written at once: position, velocity and time of every knot.

It begins and ends at rest: the phase follows a cycloid.

The pieces last exactly their time, so both axes stay together and the last knot is not a tick late.
"""

import math

import sioms
from sioms import command

RADIUS, PERIOD, PIECES = 0.04, 2.0, 200


def main() -> None:
    with sioms.Workcell() as cell, cell.open("mod0.xy", "rw") as xy:
        centre = [0.10, 0.10]
        xy.write([command(0, position=centre[0] + RADIUS), command(1, position=centre[1])])
        xy.wait_until_idle(timeout=5.0)
        records = []
        for knot in range(1, PIECES + 1):
            share = knot / PIECES
            phase = 2 * math.pi * share - math.sin(2 * math.pi * share)
            speed = RADIUS * 2 * math.pi / PERIOD * (1 - math.cos(2 * math.pi * share))
            for axis, (x, v) in enumerate((
                (math.cos(phase), -math.sin(phase)), (math.sin(phase), math.cos(phase)),
            )):  # fmt: skip
                records.append(
                    command(
                        axis, position=centre[axis] + RADIUS * x, velocity=speed * v, time=PERIOD / PIECES,
                        synch=knot == 1,
                    )
                )  # fmt: skip
        xy.write(records)
        start_ns = xy.synch()
        xy.wait_until_idle(timeout=PERIOD + 2.0)
        took_s = (xy.read().stamp_ns - start_ns) / 1e9
        print(f"{len(records)} commands, {took_s:.3f} s, back at {[round(x, 4) for x in xy.read().position]}")


if __name__ == "__main__":
    main()
