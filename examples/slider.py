"""A slider in the terminal: arrow keys move an axis, space stops it, q quits.

Every key replaces the command in flight; the axis re-plans from its present state without a jump.
"""

import os
import select
import sys
import termios
import tty

import sioms

STEP = 0.01  # m


def main(node: str) -> None:
    saved = termios.tcgetattr(sys.stdin)
    with sioms.Workcell() as cell, cell.open(node, "rw") as axis:
        channel = axis.info.channels[0]
        low, high = channel.minimum or 0.0, channel.maximum or 1.0
        target = axis.read().position[0]
        keys = select.poll()
        keys.register(sys.stdin, select.POLLIN)
        tty.setcbreak(sys.stdin)
        try:
            while True:
                share = (axis.read().position[0] - low) / (high - low)
                bar = "".join("#" if i / 50 <= share else "-" for i in range(51))
                print(
                    f"\r{low:6.3f} [{bar}] {high:6.3f}  {axis.read().position[0]:8.4f} {channel.unit} ",
                    end="",
                    flush=True,
                )
                if not keys.poll(50):
                    continue
                for key in os.read(sys.stdin.fileno(), 64).decode(errors="replace"):
                    if key == "q":
                        return
                    if key == " ":
                        axis.stop()
                        target = axis.read().position[0]
                    elif key in "CD":  # the last byte of the right and left arrow keys
                        target = min(high, max(low, target + (STEP if key == "C" else -STEP)))
                        axis.move(target, replace=True)
        finally:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, saved)
            print()


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "mod0.xaxis")
