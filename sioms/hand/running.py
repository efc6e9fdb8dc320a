"""Carry a skill out on any hand: one loop for a simulated plane and for a hand of a cell."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TypeVar

from sioms.hand.touch import Reading, Setpoint

T = TypeVar("T")


def carried_out(
    skill: Generator[Setpoint, Reading, T], tick: Callable[[Setpoint], Reading], begin_s: float, most_s: float
) -> T:
    """Send a skill the reading of each tick until it ends; return what it found.

    What ends the ticks is thrown into the skill, which names it in its events.

    Args:
        skill: the generator of `Skills`.
        tick: has a set-point carried out and returns the next reading.
        begin_s: time of the last reading before it [s].
        most_s: how long it may take, in the time of the readings [s].

    Raises:
        Failed: as the skill does.
        OSError, ValueError: as the tick does.
        TimeoutError: it takes longer; the caller sees to it that the hand stands.
    """
    reading_s = begin_s
    try:
        setpoint = next(skill)
        while reading_s < begin_s + most_s:
            try:
                reading = tick(setpoint)
            except (OSError, ValueError) as error:
                skill.throw(error)
                raise
            reading_s = reading.time_s
            setpoint = skill.send(reading)
        late = TimeoutError(f"run skill: not done in {most_s:g} s")
        skill.throw(late)
        raise late
    except StopIteration as done:
        found: T = done.value
        return found
