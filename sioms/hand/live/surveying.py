"""Survey a known object with the hand of a running workcell: what records for ``sioms reconcile hand`` come from."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from sioms.client.workcell import Workcell
from sioms.hand.live.beside import Beside
from sioms.hand.live.cell import FINGERS, CellHand
from sioms.hand.survey import Setting, Survey, Thing

MOST_S = 24 * 3600.0
#: Carries a plan out, the second argument being the number of its first grasp; returns how many were recorded.
Carry = Callable[[Sequence[Setting], int], int]


@dataclass(frozen=True, slots=True)
class Nodes:
    """Nodes of a hand; immutable.

    Args:
        hand: its coordinates.
        fingers: what each feels.
        modules: axes x, y, th of each.
        wrists: force sensors of both, or none.
    """

    hand: str = "hand"
    fingers: tuple[str, ...] = FINGERS
    modules: tuple[str, ...] = ("left", "right")
    wrists: tuple[str, ...] = ("wrist1", "wrist2")


@contextmanager
def surveying(cell: Workcell, nodes: Nodes, thing: Thing, slips: bool) -> Iterator[tuple[Survey, Carry]]:
    """Take the hand; give a survey, and what carries plans out with it.

    Args:
        slips: drag the fingers along the object, which is clamped.

    Raises:
        OSError: a node that is not there, or a hand that was stopped.
        Failed: by ``Carry``, as of the survey.
    """
    with Beside(cell, nodes.modules, nodes.wrists) as beside, CellHand(cell, nodes.hand, nodes.fingers) as hand:
        survey = Survey(hand.hand, hand.reading, thing, hand.manner)

        def carry(plan: Sequence[Setting], first: int) -> int:
            ticks = survey.slide if slips else survey.carry_out
            return hand.run(ticks(plan, lambda: beside.read(hand.told), first), MOST_S)

        yield survey, carry
