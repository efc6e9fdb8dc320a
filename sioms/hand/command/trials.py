"""``sioms hand trials``: random convex objects in a simulated plane, and what becomes of each grasp.

The physics is imported when the command runs, not before.
"""

from __future__ import annotations

import argparse
import math

from sioms.arguments import whole


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("--count", type=whole(1), default=10, metavar="N", help="objects (default 10)")
    parser.add_argument("--first", type=whole(), default=0, metavar="N", help="number of the first object (default 0)")
    parser.add_argument(
        "--shapes", nargs="+", metavar="SHAPE", default=None,
        help="families of objects, in turn: disk, ellipse, rectangle, polygon, spline, hull (default: all but hull)",
    )  # fmt: skip
    parser.add_argument("--seed", type=whole(), default=1, metavar="N", help="seed of the objects (default 1)")


def run(args: argparse.Namespace) -> int:
    """Carry out the trials; print a line for each, the share of every family, and what was lost.

    Raises:
        ValueError: an unknown family.
    """
    from sioms.hand.trials import FAMILIES, SHAPES, SURE, WITHIN_RAD, carry_out, draw, losses, share

    shapes = args.shapes or SHAPES
    if odd := [shape for shape in shapes if shape not in FAMILIES]:
        raise ValueError(f"draw objects: no family {', '.join(odd)}; want {', '.join(FAMILIES)}")
    outcomes = []
    print(f"{'object':>6} {'shape':9} {'friction':>8} {'eta first':>9} {'eta last':>8} regrasps rolls  outcome")
    for number in range(args.first, args.first + args.count):
        one = carry_out(draw(number, args.seed, shapes))
        outcomes.append(one)
        how = one.fault.value if one.fault else "held"
        print(
            f"{one.number:6d} {one.shape:9} {one.friction:8.2f} {math.degrees(one.first_rad):9.2f} "
            f"{math.degrees(one.last_rad):8.2f} {one.regrasps:8d} {one.rolls:5d}  {how}{' dropped' * one.dropped}"
            f"{' without a warning' * (not one.warned)}",
            flush=True,
        )
    print(f"friction angle within {math.degrees(WITHIN_RAD):g} degree after at most two regrasps or one roll:")
    for shape in (*FAMILIES, ""):
        if any(one.shape == shape or not shape for one in outcomes):
            print(f"{shape or 'all':9} {100 * share(outcomes, shape):5.1f} %")
    lost = losses(outcomes)
    print(f"lost: {lost.sure} of {lost.of_sure} with a coefficient of {SURE:g} and more; {lost.slippery} of "
          f"{lost.of_slippery} below it, {lost.silent} of them without a warning before")  # fmt: skip
    return 0
