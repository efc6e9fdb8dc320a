"""``sioms hand reproduce``: the source's experiments in the simulated plane: what it reports, what comes out, and why.

The physics is imported when the command runs, not before.
"""

from __future__ import annotations

import argparse

from sioms.arguments import whole

NAMES = tuple(f"E{number}" for number in range(1, 10))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("names", nargs="*", metavar="NAME", help="E1 to E9; all when none is named")
    parser.add_argument("--seed", type=whole(), default=1, metavar="N", help="seed of the noise (default 1)")


def run(args: argparse.Namespace) -> int:
    """Carry out the experiments; print source, ours and why they differ."""
    from sioms.hand.experiments.reproduce import EXPERIMENTS

    wrong = [name for name in args.names if name not in NAMES]
    if wrong:
        raise ValueError(f"reproduce {wrong[0]}: there is no such experiment; there are {', '.join(NAMES)}")
    for name in args.names or NAMES:
        told = EXPERIMENTS[name](args.seed)
        print(f"\n{name}  {told.what}")
        for label, text in (("source", told.source), ("ours", told.ours), ("why", told.why)):
            for number, line in enumerate(text.splitlines()):
                print(f"  {label if number == 0 else '':7} {line}", flush=True)
    return 0
