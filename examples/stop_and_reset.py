"""The emergency stop from any program: latched, with its reason, until somebody entitled resets it.

This is a software stop (category 1 or 2 of IEC 60204-1 at best), not a safety-rated function.
"""

import time

import sioms


def main() -> None:
    with sioms.Workcell() as cell, cell.open("mod0.xaxis", "rw", lease=2.0) as axis:
        axis.command(velocity=0.1)
        time.sleep(0.3)
        cell.emergency_stop(why="the example says so")
        time.sleep(0.2)
        reading = axis.read()[0]
        print(f"at rest: {reading.velocity:.3f} m/s, {sioms.AxisStatus(reading.status)!r}")
        try:
            axis.move(0.0)
        except OSError as error:
            print("refused:", error.strerror)
        cell.reset()
        axis.move(0.0)
        axis.wait_until_idle(timeout=5.0)
        print("back at", axis.read().position[0])


if __name__ == "__main__":
    main()
