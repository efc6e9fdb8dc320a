"""``sioms hand grasp|sense|classify|regrasp|roll|hold|release``: one skill on the hand of a running workcell.

Each begins with what is there: `grasp` with an open hand, the others with an object that both fingers touch. When the
command ends, the hand stands, and the springs of its axes keep the object; the next one squeezes it anew.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Generator
from importlib import import_module
from typing import Any, Protocol, TypeVar

from sioms.arguments import positive
from sioms.hand.command.arguments import add_hand
from sioms.hand.kinematics import Hand
from sioms.hand.touch import Event, Failed, Manner, Reading, Sensed, Setpoint

T = TypeVar("T")
HOLD_S = 5.0


class AnyHand(Protocol):
    """A hand that carries out skills: of a cell, or of a simulated plane."""

    hand: Hand
    reading: Reading

    def run(self, ticks: Generator[Setpoint, Reading, T]) -> T:
        """Carry out a skill to its end; return what it found."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments, which all skills share."""
    add_hand(parser)
    parser.add_argument(
        "--force", type=positive, default=1.0, metavar="N", help="internal force in newtons (default 1)"
    )
    parser.add_argument(
        "--time", type=positive, default=HOLD_S, metavar="S", help=f"duration of `hold` (default {HOLD_S:g} s)"
    )


def run(args: argparse.Namespace) -> int:
    """Carry out the skill on the cell; print what it found.

    Raises:
        Failed: as the skill does.
        OSError: a node that is not there, or a hand that was stopped.
    """
    from sioms.client.workcell import Workcell
    from sioms.hand.live.cell import MANNER, CellHand

    import_module("sioms.hand.skills")  # takes longer than the hand's lease on a busy machine
    if not 0.0 < args.force <= MANNER.most_n:
        raise ValueError(f"squeeze with {args.force:g} N; want above 0 and at most {MANNER.most_n:g} N")
    if not 0.0 < args.time < math.inf:
        raise ValueError(f"hold for {args.time:g} s; want above 0, finite")
    with Workcell(name="hand") as cell, CellHand(cell, args.node, args.fingers) as hand:
        manner = manner_of(hand.manner, args.force)
        found = carry_out(hand, args.hand_command, manner, args.time, lambda event: print(told(event), file=sys.stderr))
    for line in lines(found) if found is not None else []:
        print(line)
    return 0


def manner_of(manner: Manner, force_n: float) -> Manner:
    """Return a manner with another force of grasps; light touches are no firmer than it."""
    from dataclasses import replace

    return replace(manner, force_n=force_n, light_n=min(manner.light_n, force_n))


def carry_out(
    hand: AnyHand, verb: str, manner: Manner, time_s: float, tell: Callable[[Event], None]
) -> Sensed | None:  # fmt: skip
    """Carry out a skill on any hand; return what was felt last, None after a release.

    Args:
        hand: what carries it out.
        verb: the sub-command.
        manner: how.
        time_s: of `hold`.
        tell: called with each event of the skills.

    Raises:
        Failed: as the skill does.
    """
    from sioms.hand.skills import Skills

    skills = Skills(hand.hand, hand.reading, manner)
    steps: dict[str, Callable[[Any], Any]] = {
        "grasp": lambda _: skills.grasp(),
        "sense": lambda _: skills.feel(),
        "classify": lambda _: skills.feel(),
        "regrasp": skills.regrasp,
        "roll": lambda _: skills.roll(),
        "hold": lambda _: skills.hold(time_s),
        "release": lambda _: skills.release(),
    }
    try:
        felt = hand.run(skills.feel()) if verb in ("regrasp", "roll", "hold") else None
        found: Sensed | None = hand.run(steps[verb](felt))
        return found
    except Failed as failed:
        skills.events = [event for event in skills.events if event.text != str(failed)]  # it is told by who catches it
        raise
    finally:
        for event in skills.events:
            tell(event)


def told(event: Event) -> str:
    """Return an event as a line."""
    return f"{event.time_s:7.2f} s  {event.state.value:8}  {event.text}"


def lines(found: Sensed) -> list[str]:
    """Return what was felt, for a person."""
    held = found.grasp
    degrees = [math.degrees(eta) for eta in (held.eta1, held.eta2)]
    told = [
        f"friction angles  {degrees[0]:.2f} and {degrees[1]:.2f} deg, each +- {math.degrees(found.deviation):.2f}",
        f"object           {found.likeness.value}-like, {1e3 * held.apart_m:.2f} mm between the contacts",
        f"force            {found.force:.2f} N",
    ]
    for i, (contact, place, bend, deviation) in enumerate(
        zip((held.contact1, held.contact2), found.places, found.curvatures, found.curvature_deviations, strict=True), 1
    ):
        told.append(
            f"finger {i}         at {1e3 * contact[0]:.2f}, {1e3 * contact[1]:.2f} mm, "
            f"{math.degrees(place):.1f} deg on the finger, curvature {bend:.1f} +- {deviation:.1f} 1/m"
        )
    return told
