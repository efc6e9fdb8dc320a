"""``sioms hand demo``: an unknown object is grasped, regrasped, rolled and held, knocked, and then a finger dies.

Everything is simulated in this process: object and rubber, noisy strain frames, the estimator, the axes and their
controller at 400 Hz. The skills see what the fingers tell and nothing else.
"""

from __future__ import annotations

import argparse
import math
import shutil
import sys
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING

from sioms.arguments import whole

if TYPE_CHECKING:
    from sioms.hand.command.frames import Film, Frame
    from sioms.hand.plane import PlaneHand
    from sioms.hand.skills import Skills
    from sioms.hand.touch import Reading, Sensed, Setpoint

KNOCK_NS, SPIN_NMS = 0.02, 2.0e-4
"""Impulse across the line of centres, and moment of momentum, of the disturbance [N s, N m s]."""
HELD_S = 3.0
FILM_HZ = 12.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("--object", type=whole(), default=19, metavar="N", help="number of the object (default 19)")
    parser.add_argument("-o", "--output", type=Path, default=Path("out"), help="folder for picture and animation")
    parser.add_argument("--no-animation", action="store_true", help="write the picture only")
    parser.add_argument("--quiet", action="store_true", help="draw nothing in the terminal")


def run(args: argparse.Namespace) -> int:
    """Carry out the demonstration; write hand.png and hand.gif."""
    from sioms.hand.command.film import animation, picture
    from sioms.hand.command.frames import Film
    from sioms.hand.plane import PlaneHand
    from sioms.hand.skills import Skills
    from sioms.hand.touch import Failed, Manner
    from sioms.hand.trials import draw
    from sioms.plant.planar import Body, Mount

    if args.object < 0:
        raise ValueError(f"take object {args.object}: want 0 or more")
    subject = draw(args.object)
    hand = PlaneHand(Body(subject.outline), subject.pose, mount=Mount(friction=subject.friction), seed=args.object)
    skills = Skills(hand.hand, hand.reading, Manner(taps=0))  # so that there is something left to roll
    points = [(float(x), float(y)) for x, y in subject.outline.points]
    film, screen = Film(skills, FILM_HZ), None if args.quiet else Screen(points)

    def look(hand: PlaneHand, setpoint: Setpoint) -> None:
        frame = film.look(hand, setpoint)
        if frame is not None and screen is not None:
            screen.show(frame)

    hand.seen = look
    marks: list[tuple[float, str]] = []
    try:
        hand.run(_story(hand, skills, marks))
    except Failed as failed:
        end = f"{failed.fault.value}: {failed}"
    else:
        raise RuntimeError("demonstrate hand: the finger that died was not missed")
    for _ in range(80):
        hand.tick(_frozen(skills))
    marks.append((hand.world.time_s - 0.1, "finger 2 is dead"))
    if screen is not None:
        screen.close()
    _summary(film, skills, subject.shape, end)
    args.output.mkdir(parents=True, exist_ok=True)
    picture(args.output / "hand.png", film.frames, points, marks)
    written = [args.output / "hand.png"]
    if not args.no_animation:
        animation(args.output / "hand.gif", film.frames, points, FILM_HZ)
        written.append(args.output / "hand.gif")
    print("wrote", *written)
    return 0


def _story(
    hand: PlaneHand, skills: Skills, marks: list[tuple[float, str]]
) -> Generator[Setpoint, Reading, Sensed]:  # fmt: skip
    """Grasp, regrasp, roll what is left, hold; be knocked and hold; lose a finger."""
    manner = skills.manner
    found = yield from skills.grasp()
    marks.append((hand.world.time_s, "first grasp"))
    if found.grasp.quality > manner.tolerance_rad:
        found = yield from skills.regrasp(found)
        marks.append((hand.world.time_s, "regrasped"))
    if found.grasp.quality > manner.tolerance_rad:
        yield from skills.roll()
    yield from skills.hold(HELD_S)
    marks.append((hand.world.time_s, "rolled and held"))
    _knock(hand, skills)
    yield from skills.hold(HELD_S)
    marks.append((hand.world.time_s, "held after a knock"))
    hand.silent[1] = hand.world.time_s
    return (yield from skills.hold(10.0))


def _knock(hand: PlaneHand, skills: Skills) -> None:
    """Hit the object from the side."""
    world, direction = hand.world, hand.hand.forward(hand.reading.joints)[2]
    mass = world.body.mass
    world.speed[0] -= KNOCK_NS / mass * math.sin(direction)
    world.speed[1] += KNOCK_NS / mass * math.cos(direction)
    world.speed[2] += SPIN_NMS / (mass * world.body.outline.gyration_m**2)
    skills.say(f"somebody knocks the object with {1e3 * KNOCK_NS:g} mN s")


def _frozen(skills: Skills) -> Setpoint:
    from sioms.hand.motions import STILL
    from sioms.hand.touch import Setpoint

    return Setpoint(skills.hand.forward(skills.now.joints), STILL, 0.0, frozen=True)


def _summary(film: Film, skills: Skills, shape: str, end: str) -> None:
    """Print what happened, and what was true."""
    print(f"the shape of the object: {shape}; the hand did not know")
    for event in skills.events:
        print(f"{event.time_s:7.2f} s  {event.state.value:8}  {event.text}")
    held = [frame for frame in film.frames if frame.state == "hold"]
    if held:
        worst = max(max(abs(eta) for eta in frame.eta) for frame in held[-20:])
        print(f"true friction angles in the end of the hold: at most {math.degrees(worst):.2f} deg")
    print(f"it ended by itself: {end}")


class Screen:
    """The terminal: redrawn in place; elsewhere one line for each state."""

    def __init__(self, outline: list[tuple[float, float]]) -> None:
        self._outline, self._drawn, self._state = outline, 0, ""
        self._places = sys.stdout.isatty() and shutil.get_terminal_size().lines > 26

    def show(self, frame: Frame) -> None:
        """Draw a frame."""
        from sioms.hand.command.canvas import drawn

        if not self._places:
            if frame.state != self._state:
                print(f"{frame.time_s:7.2f} s  {frame.state}", flush=True)
            self._state = frame.state
            return
        rows = drawn(frame, self._outline)
        up = f"\033[{self._drawn}A" if self._drawn else ""
        print(up + "".join(f"\033[K{row}\n" for row in rows), end="", flush=True)
        self._drawn = len(rows)

    def close(self) -> None:
        """Leave the last frame where it is."""
        self._drawn = 0
