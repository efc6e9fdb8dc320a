"""Two modules and a gripper, kept in step by markers.

All motion is in the buffers before anything moves. A marker that a trajectory signals tells the
program when to close the gripper; a marker that the program signals lets the trajectory go on.
"""

import sioms
from sioms import command

X, Z = 0, 2


def main() -> None:
    with (
        sioms.Workcell() as cell,
        cell.open("mod0", "rw") as arm,
        cell.open("mod1.xaxis", "rw") as feeder,
        cell.open("gripper0.bit0", "rw") as gripper,
        cell.open("gripper0.in") as switches,
    ):
        fed, down, gripped = cell.reserve_markers(3)
        feeder.write([command(position=0.20, signal=fed), command(position=0.0, wait=gripped)])
        arm.write([
            command(X, position=0.20),
            command(Z, position=-0.03, wait=fed, signal=down),
            command(Z, position=0.0, wait=gripped),
            command(X, position=0.05, wait=gripped),
        ])  # fmt: skip
        down.wait(timeout=5.0)
        before = switches.read()
        gripper.set(1)
        closed = switches.wait_event(mask=1, last=before, timeout=2.0)
        print(f"gripper closed, switches {closed.final:#04b}")
        gripped.signal()
        arm.wait_until_idle(timeout=5.0)
        feeder.wait_until_idle(timeout=5.0)
        print("placed at", [round(x, 4) for x in arm.read().position])


if __name__ == "__main__":
    main()
