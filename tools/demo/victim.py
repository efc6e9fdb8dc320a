"""A client that moves an axis for ever; the demo kills it in mid-motion."""

import sys
import time

import sioms


def main(node: str, velocity: float) -> None:
    """Move and say so; never stop by itself."""
    with sioms.Workcell(name="victim") as cell, cell.open(node, "rw", timeout=60.0) as axis:
        axis.command(velocity=velocity)
        print("moving", flush=True)
        time.sleep(3600)


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
