"""What a demonstration keeps of each instant, for the terminal, the picture and the animation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Self

from sioms.client.workcell import Workcell
from sioms.hand.contacts import FINGER_M, grasp_of
from sioms.hand.kinematics import LINK_M
from sioms.hand.skills import Skills
from sioms.hand.touch import Felt, Reading, State

Point = tuple[float, float]
_BODIES = ("left", "right", "prober")
_NORMAL, _ANGLE, _FX, _FY = 0, 2, 6, 7
"""Channels of what each feels."""


@dataclass(frozen=True, slots=True)
class Side:
    """A finger at an instant; immutable.

    Args:
        centre: of the finger [m].
        axis: of its link's revolute axis [m].
        contact: true place of contact, None without.
        force: true force along the normal [N].
        felt: the force that it tells [N].
        push: true force on the object, friction included [N].
    """

    centre: Point
    axis: Point
    contact: Point | None
    force: float
    felt: float
    push: Point = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Known:
    """What the hand knows of the object by touches, in the object's own coordinates [m]; immutable."""

    touches: tuple[Point, ...] = ()
    outline: tuple[Point, ...] = ()


@dataclass(frozen=True, slots=True)
class Frame:
    """An instant; immutable.

    Args:
        time_s: of the hand.
        state: of the skill.
        pose: x, y [m], angle [rad] of the object: the truth.
        sides: the two fingers.
        eta: true friction angles [rad], nan without two contacts.
        told: what has been said last.
        prober: where the prober is [m], and its force on the object [N].
        known: what the hand knows.
    """

    time_s: float
    state: str
    pose: tuple[float, float, float]
    sides: tuple[Side, Side]
    eta: tuple[float, float]
    told: str
    prober: tuple[Point, Point] | None = None
    known: Known = Known()


class Film:
    """Frames of a hand in a simulated cell, so many a second of its time; ``look`` is called after every tick.

    Args:
        cell: the session; of the simulated world it tells what is true.
        rate_hz: of the frames.

    Attributes:
        told: what has been said last by others than the skills; empty: by these.

    Concurrency: one thread.
    """

    def __init__(self, cell: Workcell, rate_hz: float = 12.5) -> None:
        self.rate_hz, self.frames, self.told = rate_hz, list[Frame](), ""
        self._known, self._count = Known(), 0
        names = ("pose", *_BODIES, *(f"{body}_joints" for body in _BODIES))
        with ExitStack() as stack:
            self._nodes: list[Any] = [stack.enter_context(cell.open(f"world.{name}")) for name in names]
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def look(self, skills: Skills, reading: Reading, ended: str = "") -> Frame | None:
        """Keep a frame when its time has come; return it.

        Args:
            skills: of the hand.
            reading: of this instant.
            ended: the state to show, instead of the skills' own.
        """
        if self.frames and reading.time_s < self.frames[-1].time_s + 1.0 / self.rate_hz - 1e-9:
            return None
        pose, *rest = (node.read().data for node in self._nodes)
        contacts, joints = rest[:3], rest[3:]
        told = self.told or (skills.events[-1].text if skills.events else "")
        frame = Frame(
            reading.time_s, ended or skills.state.value, at := (pose[0], pose[1], pose[2]),
            *_sides(contacts, joints, reading.fingers), told,
            ((joints[2][0], joints[2][1]), _push(contacts[2])), self._knows(skills, at),
        )  # fmt: skip
        self.frames.append(frame)
        return frame

    def _knows(self, skills: Skills, pose: tuple[float, float, float]) -> Known:
        """Take down what has been touched newly, where the object lies as it did when it was touched."""
        felt = skills.felt
        if felt is not None and skills.state is State.FEEL and len(felt.touches) != self._count:
            self._count = len(felt.touches)
            c, s = math.cos(pose[2]), math.sin(pose[2])

            def own(x: float, y: float) -> Point:
                return c * (x - pose[0]) + s * (y - pose[1]), c * (y - pose[1]) - s * (x - pose[0])

            outline = tuple(own(*point) for point in felt.outline().tolist()) if self._count > 2 else ()
            self._known = Known(tuple(own(*touch.point) for touch in felt.touches), outline)
        return self._known


def _sides(
    contacts: Sequence[Sequence[float]], joints: Sequence[Sequence[float]], told: Sequence[Felt]
) -> tuple[tuple[Side, Side], tuple[float, float]]:
    """Return the fingers and the true friction angles, from what the world shows of both."""
    centres, normals = [], []
    for contact, (x, y, th, *_) in zip(contacts[:2], joints[:2], strict=True):
        centres.append((x + LINK_M * math.cos(th), y + LINK_M * math.sin(th)))
        normals.append(contact[_ANGLE] + th)
    grasp = grasp_of(centres[0], centres[1], normals[0], normals[1], FINGER_M)
    touched = [contact[_NORMAL] > 0.0 for contact in contacts[:2]]
    one, two = (
        Side(
            centres[i], (joints[i][0], joints[i][1]), (grasp.contact1, grasp.contact2)[i] if touched[i] else None,
            contacts[i][_NORMAL], told[i].force if told[i].touched else 0.0, _push(contacts[i]),
        )
        for i in (0, 1)
    )  # fmt: skip
    return (one, two), (grasp.eta1, grasp.eta2) if all(touched) else (math.nan, math.nan)


def _push(contact: Sequence[float]) -> Point:
    return -contact[_FX], -contact[_FY]
