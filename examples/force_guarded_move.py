"""Approach until something is touched, then hold a force, then retract.

The guard runs in the program; the axis has its own limits and stops by itself if the program dies.
"""

import sioms

TOUCH = 0.5  # N
PRESS = 4.0  # N


def main() -> None:
    with (
        sioms.Workcell() as cell,
        cell.open("mod1.zaxis", "rw", lease=0.2) as axis,
        cell.open("lord1") as sensor,
    ):
        sensor.zero(samples=100)
        axis.command(velocity=0.02)
        snapshot = sensor.read()
        while abs(snapshot.measured(2)) < TOUCH:  # an error, and the axis halts, if the force is not known
            axis.keepalive()
            snapshot = sensor.wait_new(snapshot.number, timeout=1.0)
        touched = axis.read().position[0]
        print(f"touched at {touched * 1e3:.2f} mm")
        axis.command(force=PRESS, time=0.5, replace=True)
        axis.wait_until_idle(timeout=2.0)
        print(f"force now {sensor.read().data[2]:+.2f} N, position held")
        axis.move(touched - 0.01)
        axis.wait_until_idle(timeout=5.0)


if __name__ == "__main__":
    main()
