"""``sioms hand``: the two-fingered hand from the shell.

Each sub-command is a module of this package, loaded only when it is called: ``add_arguments(parser)`` adds its
arguments, ``run(args) -> int`` carries it out and returns the exit status.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from sioms.hand.touch import Failed


@dataclass(frozen=True, slots=True)
class Verb:
    """A sub-command: its module within this package, and one line for the overview."""

    module: str
    text: str


VERBS: dict[str, Verb] = {
    "friction": Verb("friction", "drag rubber over indenters in a simulated rig and fit the coefficients of friction"),
    "reproduce": Verb("reproduce", "repeat the published experiments in a simulated plane and explain differences"),
    "demo": Verb("demo", "demonstrate grasp, regrasp, roll, hold, a push and a failed finger on an unknown object"),
    "grasp": Verb("skill", "close on whatever is between the fingers and measure the contacts"),
    "sense": Verb("skill", "measure what is held: friction angles, contacts, curvatures"),
    "classify": Verb("skill", "tell whether the object behaves like a disk or like a rectangle"),
    "regrasp": Verb("skill", "open, move to the predicted parallel grasp, and close again"),
    "roll": Verb("skill", "roll the object until the grasp is parallel"),
    "hold": Verb("skill", "hold for a time, keeping the grasp parallel by rolling"),
    "release": Verb("skill", "open the hand"),
    "record": Verb("record", "grasp a known object in many ways and record what sioms reconcile hand reads"),
    "slow": Verb("slow", "write the configuration of a simulated hand in slow motion, for a slow or busy machine"),
    "trials": Verb("trials", "grasp random convex objects in a simulated plane and count the outcomes"),
}


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the `hand` command to the `sioms` parser."""
    parser = subparsers.add_parser("hand", help="grasp, regrasp, roll and hold unknown objects by touch")
    verbs = parser.add_subparsers(dest="hand_command", required=True, metavar="COMMAND")
    for name, verb in VERBS.items():
        _module(verb).add_arguments(verbs.add_parser(name, help=verb.text, description=verb.text.capitalize() + "."))


def run(args: argparse.Namespace) -> int:
    """Run the chosen sub-command; return the exit status, 1 with a sentence for what the user can mend."""
    try:
        return int(_module(VERBS[args.hand_command]).run(args))
    except Failed as failed:
        print(f"sioms hand {args.hand_command}: {failed.fault.value}: {failed}", file=sys.stderr)
    except ValueError as error:
        print(f"sioms hand {args.hand_command}: {error}", file=sys.stderr)
    return 1


def _module(verb: Verb) -> Any:
    return import_module(f"{__name__}.{verb.module}")
