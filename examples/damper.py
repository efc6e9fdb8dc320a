"""Damper control as a script: an axis gives way to the force on a sensor.

The same as damper.sh, at the sensor's own rate and with a lease: should this program hang, the axis
halts after 250 ms. A force that is flagged invalid or saturated raises an error, which closes the axis: it halts.
"""

import sys

import sioms

GAIN = 0.005  # (m/s)/N


def main(seconds: float) -> None:
    with (
        sioms.Workcell() as cell,
        cell.open("lord1") as sensor,
        cell.open("mod0.xaxis", "rw", lease=0.25) as axis,
    ):
        sensor.zero(samples=50)
        snapshot = sensor.read()
        end_ns = snapshot.stamp_ns + int(seconds * 1e9)
        while snapshot.stamp_ns < end_ns:
            snapshot = sensor.wait_new(snapshot.number, timeout=1.0)
            axis.command(velocity=-GAIN * snapshot.measured(), replace=True)
        print(f"at {axis.read().position[0] * 1e3:.2f} mm after {seconds:g} s")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 2.0)
