"""``sioms hand friction``: drag rubber over indenters in the simulated rig and fit the coefficients of table 4.2."""

from __future__ import annotations

import argparse
import math

from sioms.arguments import positive, whole


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("--speed", type=positive, default=5.0, metavar="MM/S", help="drag speed (default 5)")
    parser.add_argument("--seed", type=whole(), default=1, metavar="N", help="seed of the noise (default 1)")


def run(args: argparse.Namespace) -> int:
    """Run the rig; print the source's table beside ours."""
    from sioms.hand.friction import WEIGHTS_KG, Drag, curvature_on_finger, table

    if not 0.5 <= args.speed <= 50.0:
        raise ValueError(f"drag at {args.speed:g} mm/s: want 0.5 to 50 mm/s, so that it slides within the run")
    print(f"weights {', '.join(f'{1e3 * one:g}' for one in WEIGHTS_KG)} g, {args.speed:g} mm/s")
    print(f"{'R mm':>6} {'rc mm':>7} {'source':>7} {'ours':>7} {'+-':>6} {'over load':>10}  sliding")
    for row in table(Drag(speed=1e-3 * args.speed), seed=args.seed):
        how = f"sticks and slips at {row.cycle_hz:.0f} Hz in {row.sticks} runs" if row.sticks else "evenly"
        rc = 1e3 * curvature_on_finger(row.radius_m)
        print(
            f"{1e3 * row.radius_m:6.1f} {rc:7.1f} {row.source:7.1f} {row.coefficient:7.3f} {row.deviation:6.3f} "
            f"{row.over_load:8.1f} s  {how}"
        )
    print("over load: slope of the coefficient over the weight, in its standard deviations s")
    print(f"adopted: at least 1.4, cone of {math.degrees(math.atan(1.4)):.1f} degrees on either side")
    return 0
