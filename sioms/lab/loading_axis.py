"""Press on something with an axis until a force is felt: feel for the surface, learn the way in, press with a force.

Two nodes make a loading axis: an axis that presses [m, larger is further in] and one channel of a force [N, larger when
pressed]. The axis' own limits, its guard and the emergency stop hold as ever; whatever it does is watched.
"""

from __future__ import annotations

import errno
import math
import time
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.lab.stopping import ExperimentStopped, check_running

Floats = NDArray[np.float64]

POLL_S = 2e-3
MOVE_S = 10.0  # longest move
#: The surface is felt for at one speed [m/s], the way in at another; a force is that of so many samples.
FEEL_M_S, LEARN_M_S, NEAR = 5e-3, 1e-3, 8
#: On the way the axis is sent no further ahead than it goes in so long [s]: it rests when this program does not look.
AHEAD_S = 0.04
FELT = 0.1  # of the largest force: the surface has been found
LEARNT, OVER = 1.08, 1.3  # of the largest force: the way in is known up to there; pressing is stopped
AGE_S = 0.5  # a force that is older is not known
SETTLED, TARED = 60, 50  # samples of the force after a move; in a tare


class LoadingAxis:
    """Loads a sensor with one axis and measures with one force channel. One thread.

    While it relies on the force, a force that is not measured, or old, ends it with EIO, and the axis stops.

    Args:
        axis, force: open nodes; the axis for writing.
        most_n: nothing is pressed harder than this [N], and a third above it the experiment is stopped.
        clear_m: distance from the surface where nothing is touched.
        watched: further axes that must not be stopped while this presses; they are kept alive, too.
    """

    def __init__(self, axis: Any, force: Any, most_n: float, clear_m: float, watched: Sequence[Any] = ()) -> None:
        self.axis, self.force, self.most_n = axis, force, most_n
        self._clear_m, self._axes = clear_m, (axis, *watched)
        self.surface = self.tare_n = math.nan
        self._ways: dict[Hashable, tuple[Floats, Floats]] = {}  # position and force on the way in
        self._way: Hashable = None

    def take(self, way: Hashable) -> bool:
        """Go by a way in from now on (that of an indenter, of a place); say whether it has been learnt."""
        self._way = way
        return way in self._ways

    def tare(self) -> None:
        """Take the force that is there for none."""
        self.tare_n = float(np.mean([s.measured() for s in self.watch_for(TARED)]))

    def learn(self) -> None:
        """Feel for the surface and learn how far the axis must go for a force; it must be clear, and tared.

        Raises:
            ExperimentStopped: there is nothing, or the axis is stopped.
        """
        way, _ = self._feel(FEEL_M_S, FELT * self.most_n)
        self.surface = float(way[-1])
        self.clear()
        way, force = self._feel(LEARN_M_S, LEARNT * self.most_n)
        self.clear()
        position, force = self._ways[self._way] = _rising(way, force)
        self.surface = self.depth(0.0)
        # a force lags behind a motion: a press at rest sets the scale
        half = 0.5 * self.most_n
        self.press(half)
        at_rest = self.net(self.watch_for(TARED))
        self.clear()
        self._ways[self._way] = position, force * (at_rest / half)

    def depth(self, force_n: float) -> float:
        """Return where the axis must go for a force [N].

        Raises:
            ValueError: it is more than the largest.
        """
        if force_n > self.most_n * (1.0 + 1e-9):
            raise ValueError(f"press with {force_n:g} N: the most for {self.axis.name} is {self.most_n:g} N")
        position, force = self._ways[self._way]
        return float(np.interp(force_n, force, position))

    def press(self, force_n: float) -> None:
        """Press with a force [N], at most the largest, and let it settle."""
        self.move(self.axis, self.depth(force_n))
        self.watch_for(SETTLED)

    def clear(self) -> None:
        """Take the axis off what it presses, whatever it feels."""
        if not math.isnan(self.surface):
            self.move(self.axis, self.surface - self._clear_m, guarded=False)

    def move(self, node: Any, position: float, guarded: bool = True) -> None:
        """Move an axis at its limits and wait until it rests, watching the force unless ``guarded`` is off.

        Raises:
            ExperimentStopped: an axis is stopped, does not come there, or the force is too large.
        """
        limits = node.info.channels[0].limits  # those of a command stay in force until others come
        speed, acceleration = limits["velocity"], limits["acceleration"]
        deadline = time.monotonic() + MOVE_S
        with self._stopped_by_errors(node):
            taken = node.command(position=position, max_velocity=speed, max_acceleration=acceleration, replace=True)
            while True:
                time.sleep(POLL_S)
                self.check(guarded)
                seen = node.read()
                if seen.tick > taken and not seen.in_motion[0] and not seen.buffered[0]:
                    return
                if time.monotonic() > deadline:
                    raise ExperimentStopped(f"move {node.name} to {position:.4g}: not there within {MOVE_S:g} s")

    def watch_for(self, samples: int) -> list[Any]:
        """Wait for so many samples of the force as it is from now on, watching it; return them.

        What a busy device or line brings late was felt before the move that led here.
        """
        begin_ns, last = time.monotonic_ns(), self.force.read().number
        deadline = time.monotonic() + MOVE_S
        seen: list[Any] = []
        while len(seen) < samples:
            if time.monotonic() > deadline:
                raise ExperimentStopped(f"read {self.force.name}: no {samples} samples within {MOVE_S:g} s")
            time.sleep(POLL_S)
            self.check()
            news = self.force.history(last)
            last = news[-1].number if news else last
            seen += [one for one in news if one.stamp_ns >= begin_ns]
        return seen

    def keep_alive(self) -> None:
        """Say that this program is alive."""
        for node in self._axes:
            node.keepalive()

    def check(self, guarded: bool = True) -> None:
        """Look whether the experiment may go on, and say that this program is alive.

        Raises:
            ExperimentStopped: an axis is stopped, or the force is too large.
            OSError: EIO, the force is not known.
        """
        self.keep_alive()
        for node in self._axes:
            check_running(node.name, node.read())
        most = OVER * self.most_n
        if guarded and not math.isnan(self.tare_n):
            newest = self.force.read()
            age_s = (time.monotonic_ns() - newest.stamp_ns) * 1e-9
            if age_s > AGE_S:
                text = f"press {self.axis.name}: the force of {self.force.name} is {age_s:.2f} s old; want {AGE_S:g} s"
                raise OSError(errno.EIO, text)
            force = self.net(self.force.history(newest.number - NEAR) or [newest])
            if force > most:
                raise ExperimentStopped(f"press {self.axis.name}: {force:.3g} N, more than {most:.3g} N")

    def net(self, forces: Sequence[Any]) -> float:
        """Return the mean force less the tare [N]; raises OSError, EIO, where one is no measurement."""
        return float(sum(s.measured() for s in forces)) / max(len(forces), 1) - self.tare_n

    @contextmanager
    def _stopped_by_errors(self, node: Any) -> Iterator[None]:
        """Stop an axis before an error is told, whatever it is: nobody watches the force then."""
        try:
            yield
        except BaseException:
            with suppress(OSError):
                node.stop()
            raise

    def _feel(self, speed: float, until_n: float) -> tuple[Floats, Floats]:
        """Move in until a force is felt; return positions and forces on the way.

        The axis is sent on while the force is looked at, at each look by what it has gone since the last one: however
        late this program gets its turn, it presses no deeper than twice AHEAD_S allows.

        Raises:
            ExperimentStopped: the axis came to its end before.
        """
        channel = self.axis.info.channels[0]
        end, acceleration = channel.maximum, channel.limits["acceleration"]
        ahead = speed * AHEAD_S + speed**2 / (2.0 * acceleration)
        begin, looked_s = self.axis.read(), time.monotonic()
        last, force_last = begin.number, self.force.read().number
        seen: list[Any] = []
        forces: list[Any] = []
        sent, wanted, taken = -math.inf, float(begin.position[0]) + ahead, 0
        with self._stopped_by_errors(self.axis):
            while True:
                if sent < end and (wanted - sent > 0.5 * ahead or wanted >= end):
                    sent = min(end, wanted)
                    taken = self.axis.command(
                        position=sent, max_velocity=speed, max_acceleration=acceleration, replace=True
                    )
                time.sleep(POLL_S)
                now_s = time.monotonic()
                wanted += min(speed * (now_s - looked_s), ahead)
                looked_s = now_s
                seen += self.axis.history(seen[-1].number if seen else last)
                forces += self.force.history(forces[-1].number if forces else force_last)
                self.check()
                if len(forces) >= NEAR and self.net(forces[-NEAR:]) > until_n:
                    break
                if seen and sent == end and seen[-1].tick > taken and not seen[-1].in_motion[0]:
                    raise ExperimentStopped(
                        f"feel for a surface with {self.axis.name}: no {until_n:.3g} N on {self.force.name} up to "
                        f"{end:.4g} m; check the force sensor, the place and what is to be pressed"
                    )
        self.axis.stop()
        stamps = [s.stamp_ns for s in forces]
        at = np.interp(stamps, [s.stamp_ns for s in seen], [s.position[0] for s in seen])
        return np.asarray(at), np.array([s.data[0] for s in forces]) - self.tare_n


def _rising(position: Floats, force: Floats, bins: int = 40) -> tuple[Floats, Floats]:
    """Return positions and the force that grows with them, from no force on; a line through what is pressed leads to
    none.
    """
    inside = slice(0, int(np.argmax(position)) + 1)
    position, force = position[inside], force[inside]
    edges = np.linspace(position[0], position[-1], bins * 4)
    which = np.clip(np.searchsorted(edges, position) - 1, 0, len(edges) - 2)
    count = np.bincount(which, minlength=len(edges) - 1)
    at, felt = (np.bincount(which, v, len(edges) - 1)[count > 0] / count[count > 0] for v in (position, force))
    pressed = felt > 0.05 * felt.max()
    first = int(np.flatnonzero(~pressed)[-1]) + 1 if not pressed.all() else 0
    at, felt = at[first:], np.maximum.accumulate(felt[first:])
    slope = (felt[min(4, len(felt) - 1)] - felt[0]) / max(at[min(4, len(at) - 1)] - at[0], 1e-9)
    surface = at[0] - felt[0] / max(slope, 1e-9)
    return np.concatenate([[surface], at]), np.concatenate([[0.0], felt])
