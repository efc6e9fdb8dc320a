"""``sioms hand demo``: an unknown object is grasped, felt round, regrasped, held, pushed; then a driver is killed.

Object and sensors are simulated, all else is a workcell as any: a daemon, the drivers of two modules, of two tactile
fingers and their wrists and of the hand, and this client. The skills see what the fingers tell and nothing else.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import signal
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sioms.arguments import positive, whole

if TYPE_CHECKING:
    from sioms.client.workcell import Workcell
    from sioms.hand.command.frames import Film, Frame
    from sioms.hand.live.cell import CellHand
    from sioms.hand.skills import Skills
    from sioms.hand.touch import Reading, Sensed, Setpoint
    from sioms.hand.trials import Subject

OBJECT, SLOWEST, TRIES, TAPS = 19, 0.1, 3, 6
"""Number of the object, slowest pace, how often it is grasped, and pairs of touches, at most."""
HELD_S, PUSHED_S, CARRIED_S, AFTER_S = 1.0, 4.5, 1.5, 1.5
ROLLED_S, ROLLING, ROLL_S = 2.0, (0.2, -0.2), 8.0
"""How long and how fast the fingers roll the object off [s, rad/s], and how long they may take to roll it back."""
CARRIES = 0.012
"""Speed of the hand when the driver is killed [m/s]."""
_PRESS_M, _BESIDE_M, _NEAR_M = 6e-3, 9e-3, 0.03
"""How far the prober's spring is pressed, how far beside the middle, and from where."""
GAIN = 1.0
"""Of the rolling law [1/s]: at half the usual rates faster corrections of what sticks to the platen swing."""
LEASE_S = 1.0
"""Of the hand, in its own time: this client may be kept waiting by other work."""
_RESTS = (5e-5, 5e-5, 2e-3)
"""How near to where they come to rest the axes of a module are at rest [m, rad]."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "--object", type=whole(), default=OBJECT, metavar="N", help=f"number of the object (default {OBJECT})"
    )
    parser.add_argument(
        "--pace", type=positive, metavar="P",
        help="simulated seconds per second, at most 1 (default: what this machine carries)",
    )  # fmt: skip
    parser.add_argument("-o", "--output", type=Path, default=Path("out"), help="folder for picture and animation")
    parser.add_argument("--no-animation", action="store_true", help="write the picture only")
    parser.add_argument("--quiet", action="store_true", help="draw nothing in the terminal")


def run(args: argparse.Namespace) -> int:
    """Carry out the demonstration; write hand.png and hand.gif."""
    from sioms.hand.command.film import animation, picture
    from sioms.hand.command.stage import in_time, pace_here, staged
    from sioms.hand.trials import draw

    subject, pace = draw(args.object), args.pace or pace_here()
    points = [(float(x), float(y)) for x, y in subject.outline.points]
    screen = None if args.quiet else Screen(points)
    while True:
        print(f"a daemon, five driver processes and this client start; {pace:g} simulated seconds take one", flush=True)
        try:
            with staged(subject, pace) as cell, in_time(), Show(cell, subject, screen) as show:
                show.play()
            break
        except OSError as error:  # nothing real moves: what is late here is this machine
            if args.pace or pace <= SLOWEST:
                raise ValueError(f"demonstrate hand: {error}; try a lower --pace, or a quieter machine") from None
            pace = max(0.5 * pace, SLOWEST)
            print(f"this machine is too busy ({error}); once more, more slowly", flush=True)
    if screen is not None:
        screen.close()
    for line in show.summary():
        print(line)
    args.output.mkdir(parents=True, exist_ok=True)
    picture(args.output / "hand.png", show.film.frames, points, show.marks)
    written = [args.output / "hand.png"]
    if not args.no_animation:
        animation(args.output / "hand.gif", show.film.frames, points, show.film.rate_hz)
        written.append(args.output / "hand.gif")
    print("wrote", *written)
    return 0


class Show:
    """What happens, on a cell that is up.  One thread; use it in a ``with`` block, ``play`` once.

    Args:
        cell: the session.
        subject: the object, for the prober and the summary; the skills do not see it.
        screen: shows each frame; None: nothing does.

    Attributes:
        film: of what happened.
        marks: instants of the hand's time [s], and what they show.
    """

    def __init__(self, cell: Workcell, subject: Subject, screen: Screen | None) -> None:
        from sioms.hand.command.frames import Film
        from sioms.hand.command.stage import LATE_S, RATES, pid_of
        from sioms.hand.live.cell import CellHand
        from sioms.hand.skills import Skills

        self._cell, self._subject, self._screen = cell, subject, screen
        self._victim = pid_of(cell, "touch2")
        self._kill_s, self._killed_ns, self._rest_s, self._end = math.inf, 0, math.nan, ""
        self.marks: list[tuple[float, str]] = []
        with ExitStack() as stack:
            self._prober: Any = stack.enter_context(cell.open("prober", "rw", 10.0))
            self._modules: list[Any] = [
                stack.enter_context(cell.open(f"{name}.readonly")) for name in ("left", "right")
            ]
            self.film: Film = stack.enter_context(Film(cell))
            self._hand: CellHand = stack.enter_context(CellHand(cell, lease_s=LEASE_S))
            ticks = math.ceil(self._hand.manner.tap_frames * RATES["hand"] / 400.0)
            manner = replace(
                self._hand.manner, stale_s=2.0 * LATE_S, tap_frames=ticks, gain=GAIN, roll_s=ROLL_S, taps=TAPS
            )
            self._skills: Skills = Skills(self._hand.hand, self._hand.reading, manner)
            self._stack = stack.pop_all()

    def __enter__(self) -> Show:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def play(self) -> None:
        """Carry it all out.

        Raises:
            OSError: something ended it before the driver was killed.
            Failed: a skill could not go on.
        """
        from sioms.hand.touch import Failed

        self._hand.seen = self._look
        try:
            self._hand.run(self._story(), 600.0)
        except (Failed, OSError) as error:
            if not self._killed_ns:
                raise
            self._end = str(error)
        self._watch()

    def summary(self) -> Sequence[str]:
        """Return what happened, and what was true."""
        subject, lines = self._subject, []
        lines.append(f"the object was number {subject.number}, a {subject.shape}; the hand did not know")
        held = [frame for frame in self.film.frames if frame.state == "hold"]
        worst = max((max(map(abs, frame.eta)) for frame in held[-10:]), default=math.nan)
        lines.append(f"true friction angles at the end of the hold: at most {math.degrees(worst):.2f} deg")
        lines.append(f"driver of finger 2 killed (SIGKILL) while the hand carried the object: {self._end}")
        lines.append(f"both modules at rest {1e3 * self._rest_s:.0f} ms of the hand's time after it")
        return lines

    def _story(self) -> Generator[Setpoint, Reading, Sensed]:
        from sioms.hand.touch import Failed

        skills, tries = self._skills, TRIES
        while tries:
            try:
                yield from self._parallel()
                break
            except Failed as failed:  # the hand is frozen, or has let go
                if not (tries := tries - 1):
                    raise
                skills.say(f"{failed}: once more")
                yield from skills.release()
        yield from skills.hold(HELD_S)
        yield from self._pushed()
        self.film.told = "the fingers roll the object off"
        yield from skills.hold(ROLLED_S, rolling=ROLLING)
        self._mark(f"rolled off: {math.degrees(self._true()):.0f} deg")
        self.film.told = ""
        yield from skills.roll()
        yield from skills.hold(HELD_S)
        self._mark(f"rolled back: {math.degrees(self._true()):.1f} deg")
        psi = self._hand.coordinates[2]
        self._kill_s = skills.now.time_s + CARRIED_S
        self.film.told = "the hand carries the object; then the driver of finger 2 is killed"
        return (yield from skills.hold(20.0, (CARRIES * math.cos(psi), CARRIES * math.sin(psi))))

    def _parallel(self) -> Generator[Setpoint, Reading, None]:
        """Grasp, feel round, regrasp."""
        skills = self._skills
        self.marks.clear()
        found = yield from skills.grasp()
        self._mark(f"grasped: {math.degrees(found.grasp.quality):.0f} deg off")
        if found.grasp.quality > skills.manner.held_rad:
            found = yield from skills.regrasp(found)
            felt = [frame.time_s for frame in self.film.frames if frame.state == "feel"]
            if felt:
                self.marks.append((felt[-1], f"felt round: {skills.taps} touches"))
            self._mark(f"regrasped: {math.degrees(found.grasp.quality):.1f} deg off")

    def _pushed(self) -> Generator[Setpoint, Reading, Sensed]:
        """Hold while the prober comes, pushes the object beside its middle, and leaves."""
        from sioms.client.command import command
        from sioms.hand.command.stage import AWAY_M
        from sioms.hand.contacts import FINGER_M

        at, pace, begin = self._hand.coordinates, self._hand.pace, len(self.film.frames)
        u, v = math.cos(at[2]), math.sin(at[2])
        n = (-v, u) if u > 0.0 else (v, -u)  # from where the prober waits
        pose = self.film.frames[-1].pose
        x, y = self._subject.outline.nearest(
            pose, at[0] + _BESIDE_M * u + 0.1 * n[0], at[1] + _BESIDE_M * v + 0.1 * n[1]
        )
        way = [FINGER_M + _NEAR_M, FINGER_M - _PRESS_M, FINGER_M + _NEAR_M]
        places = [*((x + off * n[0], y + off * n[1]) for off in way), AWAY_M]
        self._prober.write([
            command(axis, position=place[axis], time=time_s / pace)
            for place, time_s in zip(places, (1.0, 1.2, 0.5, 1.0), strict=True) for axis in (0, 1)
        ])  # fmt: skip
        self.film.told = "a prober pushes the object from the side"
        held = yield from self._skills.hold(PUSHED_S)
        pushes = [(math.hypot(*frame.prober[1]), frame.time_s) for frame in self.film.frames[begin:] if frame.prober]
        most, time_s = max(pushes)
        self.marks.append((time_s, f"pushed from the side: {most:.1f} N"))
        return held

    def _true(self) -> float:
        return max(map(abs, self.film.frames[-1].eta))

    def _mark(self, text: str) -> None:
        self.marks.append((self._skills.now.time_s, text))

    def _look(self, reading: Reading, _: Setpoint | None = None) -> None:
        frame = self.film.look(self._skills, reading, "killed" if self._killed_ns else "")
        if frame is not None and self._screen is not None:
            self._screen.show(frame)
        if reading.time_s >= self._kill_s and not self._killed_ns:
            self._killed_ns = time.monotonic_ns()
            os.kill(self._victim, signal.SIGKILL)

    def _watch(self) -> None:
        """See when both modules have come to rest."""
        last, pace, now_ns = self._hand.reading, self._hand.pace, time.monotonic_ns()
        past: list[list[Any]] = [node.history(0) for node in self._modules]
        self.film.told = "the driver of finger 2 was killed: the hand is in fault, both modules stop"
        while now_ns < self._killed_ns + AFTER_S / pace * 1e9:
            for node, shown in zip(self._modules, past, strict=True):
                shown += node.history(shown[-1].number)
            self._look(replace(last, time_s=self._kill_s + (now_ns - self._killed_ns) * 1e-9 * pace))
            time.sleep(0.01)
            now_ns = time.monotonic_ns()
        moved_ns = [self._killed_ns]
        for shown in past:
            end = shown[-1].position
            moved_ns += [
                one.stamp_ns for one in shown
                if any(abs(a - b) > near for a, b, near in zip(one.position, end, _RESTS, strict=True))
            ]  # fmt: skip
        self._rest_s = (max(moved_ns) - self._killed_ns) * 1e-9 * pace
        self.marks.append((self.film.frames[-1].time_s, f"driver killed: at rest\nafter {1e3 * self._rest_s:.0f} ms"))


class Screen:
    """The terminal: redrawn in place; elsewhere one line for each state."""

    def __init__(self, outline: list[tuple[float, float]]) -> None:
        self._outline, self._drawn, self._said = outline, 0, ("", "")
        self._places = sys.stdout.isatty() and shutil.get_terminal_size().lines > 26

    def show(self, frame: Frame) -> None:
        """Draw a frame."""
        from sioms.hand.command.canvas import drawn

        if not self._places:
            for told in (frame.state, frame.told):
                if told not in self._said:
                    print(f"{frame.time_s:7.2f} s  {told}", flush=True)
            self._said = (frame.state, frame.told)
            return
        rows = drawn(frame, self._outline)
        up = f"\033[{self._drawn}A" if self._drawn else ""
        print(up + "".join(f"\033[K{row}\n" for row in rows), end="", flush=True)
        self._drawn = len(rows)

    def close(self) -> None:
        """Leave the last frame where it is."""
        self._drawn = 0
