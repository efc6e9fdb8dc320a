"""Feel round an object that lies on the platen: touch it with one finger at a time, too lightly to move it.

Nothing is held meanwhile. Every pair of touches, one of each finger along one line, is made where all touches before
it let expect a parallel grasp (`around.Around`), until both normals lie along the line: there the hand closes.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence

from sioms.hand.around import Around
from sioms.hand.contacts import FINGER_M
from sioms.hand.kinematics import Six
from sioms.hand.motions import LETTING_GO_N, Motions
from sioms.hand.regrasp import NEUTRAL
from sioms.hand.seeking import Seeking
from sioms.hand.shape import Parallel, Touch
from sioms.hand.touch import Failed, Fault, Reading, Setpoint, State
from sioms.tactile.quality import DOUBT, Quality


class Feeling(Motions):
    """Feel round objects with one hand.  One at a time.

    Attributes:
        taps: how many touches of one finger it has made.
    """

    taps = 0
    _around: Around | None = None

    def _feel_round(self, known: Sequence[Touch]) -> Generator[Setpoint, Reading, Six | None]:
        """Return where it would be held parallel, the hand being open there; None where that was not found.

        Args:
            known: touches of the grasp before, made where the hand is; none: it begins there.
        """
        before, self.state = self.state, State.FEEL
        before_n, self._most_n = self._most_n, self.manner.yield_n
        x, y, direction, d, *_ = self._goal
        around, begun = self._around or Around(), self.taps
        first = None if known else Parallel(x, y, direction, d - 2.0 * FINGER_M, math.inf)
        if self._around is not None:
            around.tried(x, y, direction)
        elif known:  # of those that were squeezed later, corners tell less than what it knows
            around.add(known, x, y, direction)
        opened = max(self._goal[3], self._free_m)
        yield from self._move((x, y, direction, opened, *self._goal[4:]))
        seeking = Seeking(around)
        for _ in range(self.manner.taps):
            one, first = first or seeking.next(direction, self._least_m), None
            if one is None:
                break
            if one.apart_m < self._least_m:
                raise Failed(
                    Fault.TOO_SMALL,
                    f"{self._what}: by {self.taps - begun} touches round it {1e3 * max(one.apart_m, 0.0):.0f} mm are "
                    f"left of it; want one wider than {1e3 * self._least_m:.0f} mm, which stays where it lies",
                )
            target: Six = (one.x, one.y, one.direction, opened, _MIDDLE_RAD, _MIDDLE_RAD)
            if not self._reaches(target):
                break
            if (yield from self._move(target)):  # it was in the way, and may lie elsewhere now
                seeking = Seeking(around := Around())
                opened = min(opened + 2.0 * self.manner.clearance_m, self.manner.opening[1] - 1e-3)
            touches: list[Touch] = []
            pushed = None
            for index in (0, 1):
                touch, pushed = yield from self._tap(index, 0.5 * one.apart_m + FINGER_M)
                touches += [touch] if touch is not None else []
                if pushed is not None:
                    break
            if pushed is not None:  # it is beside that finger, and may lie otherwise now
                self.say(f"finger {index + 1} pushes what its array does not feel, at {_place(pushed)}: felt anew")
                seeking = Seeking(around := Around())
                first = Parallel(*pushed, one.direction + 0.5 * math.pi, opened - 2.0 * FINGER_M, math.inf)
                continue
            if len(touches) < 2:
                around.missed(one.x, one.y, one.direction)
                seeking.missed()
            around.add(touches, one.x, one.y, one.direction)
            if len(touches) == 2 and seeking.is_done(touches, one):
                break
        found = seeking.found
        self._around = around
        self.say(f"felt {self.taps - begun} places round it: {'a' if found else 'no'} parallel grasp")
        self.state, self._most_n = before, before_n
        return None if found is None else (*found, self._goal[3], NEUTRAL, NEUTRAL)

    @property
    def _least_m(self) -> float:
        """Return the narrowest object that the hand closes on [m]."""
        return self.manner.opening[0] - 2.0 * FINGER_M

    def _tap(
        self, index: int, near_m: float
    ) -> Generator[Setpoint, Reading, tuple[Touch | None, tuple[float, float] | None]]:
        """Touch the object with one finger and leave it again; return what it felt, None where there is nothing, and
        where the finger was when it did not go on and felt nothing.

        Args:
            index: of the finger.
            near_m: how far from the middle the finger is expected to meet it [m].

        Raises:
            Failed: `manner.close_s` are over, or the finger tells no place that may be relied on.
        """
        manner, side = self.manner, 0.5 - index
        u, v = math.cos(self._goal[2]), math.sin(self._goal[2])
        start, way, force = list(self._goal), 0.0, 0.0
        rested_s, unfelt_s, beside_s, met = 0.0, 0.0, 0.0, False
        most, latest_s = 0.5 * start[3] + FINGER_M, self.now.time_s + manner.close_s
        touch: Touch | None = None
        pushed: tuple[float, float] | None = None
        while way < most and pushed is None:
            finger, before_s = self._feels(index), self.now.time_s
            if before_s > latest_s:
                raise Failed(
                    Fault.DOUBTFUL,
                    f"{self._what}: after {manner.close_s:g} s finger {index + 1} has told no place where it touches; "
                    f"its force is {finger.force:.2f} N; want a touch of {manner.tap_n:g} N that rests, or none",
                )
            far = 0.5 * start[3] - way > near_m + _NEAR_M
            rate = manner.moving if far else _GENTLE * manner.closing
            along: Six = (side * rate * u, side * rate * v, 0.0, -rate, 0.0, 0.0)
            met = bool(finger.touched) or (met and unfelt_s < _UNFELT_S)
            if met:
                self._yield()
                rate = 0.0 if rested_s > 0.0 or force > manner.tap_n else _CREEP * manner.closing
                along = self._by_link(index, rate)
            yield from self._follow(along, 0.0)
            gone_s = self.now.time_s - before_s
            told = self._feels(index)
            unfelt_s = 0.0 if told.touched else unfelt_s + gone_s
            beside_s = max(beside_s + gone_s * (1 if _BESIDE in told.doubt else -1 if told.touched else 0), 0.0)
            if beside_s > _BESIDE_S:  # pressed on, it would push the object away
                break
            way += rate * gone_s
            at = self._centre(index, self.now.joints)
            if not met and math.dist(at, self._centre(index, self.hand.inverse(self._goal))) > _PUSHES_M:
                pushed = at
            force += min(gone_s / _FILTER_S, 1.0) * (told.force - force)
            rested_s = rested_s + gone_s if rate == 0.0 else 0.0
            if rested_s > _RESTED_S:
                touch, presses_on = yield from self._felt_by(index)
                if not presses_on:
                    break
                rested_s = force = 0.0  # it rests too lightly
        self.taps += 1
        while (left := start[3] - self._goal[3]) > 1e-4:  # and out again
            rate = min(manner.moving, 10.0 * left)
            yield from self._follow((-side * rate * u, -side * rate * v, 0.0, rate, 0.0, 0.0), LETTING_GO_N)
        self._goal = start
        return touch, pushed

    def _centre(self, index: int, joints: Sequence[float]) -> tuple[float, float]:
        """Return the centre of a finger."""
        x, y, th = joints[3 * index : 3 * index + 3]
        length = (self.hand.link1_m, self.hand.link2_m)[index]
        return x + length * math.cos(th), y + length * math.sin(th)

    def _by_link(self, index: int, speed: float) -> Six:
        """Return rates of the coordinates at which one link alone turns its finger towards the other [m/s].

        The link is soft across itself, the carriages are not: a finger that they push on drags the object aside.
        """
        th, length = self.now.joints[3 * index + 2], (self.hand.link1_m, self.hand.link2_m)[index]
        _, _, psi, d, _, _ = self._goal
        inwards = psi if index == 0 else psi + math.pi
        turn = math.copysign(speed / length, math.sin(inwards - th))
        w = (-turn * length * math.sin(th), turn * length * math.cos(th))
        u, v = math.cos(psi), math.sin(psi)
        sign = 2.0 * index - 1.0
        opening, round_ = sign * (w[0] * u + w[1] * v), sign * (w[1] * u - w[0] * v) / d
        own = round_ - turn
        return 0.5 * w[0], 0.5 * w[1], round_, opening, round_ if index else own, own if index else round_

    def _yield(self) -> None:
        """Want the hand where it is: what an object holds back is not pushed ever harder."""
        self._goal = list(self.hand.forward(self.now.joints))

    def _felt_by(self, index: int) -> Generator[Setpoint, Reading, tuple[Touch | None, bool]]:
        """Average frames of one finger; return the place and the normal, and whether it has to press on for them.

        Without them and pressing on it rests too lightly; without both it touches beside its array.

        Raises:
            Failed: most frames say that their numbers mislead.
        """
        points: list[tuple[float, float]] = []
        normals: list[float] = []
        doubts: list[str] = []
        frames = self.manner.tap_frames
        for _ in range(frames):
            self._yield()
            yield from self._follow((0.0,) * 6, 0.0)
            finger = self._feels(index)
            if not finger.touched or not math.isfinite(finger.phi):
                continue
            if misleading := _MISLEADS.intersection(finger.doubt.split("|")):
                doubts.append(_BESIDE if _BESIDE in misleading else min(misleading))
                continue
            x, y = self._centre(index, self.now.joints)
            normal = self.now.joints[3 * index + 2] + finger.phi
            points.append((x + FINGER_M * math.cos(normal), y + FINGER_M * math.sin(normal)))
            normals.append(normal)
        count = len(normals)
        if doubts.count(_BESIDE) > frames // 2:
            return None, False
        if len(doubts) > frames // 2:
            raise Failed(
                Fault.DOUBTFUL,
                f"{self._what}: finger {index + 1} says {doubts[-1]!r} in {len(doubts)} of {frames} frames of a touch "
                "of its own; want a contact that its array covers",
            )
        if count < frames // 4:
            return None, True
        normal = normals[0] + sum(math.remainder(one - normals[0], math.tau) for one in normals) / count
        place = sum(x for x, _ in points) / count, sum(y for _, y in points) / count
        return Touch(place, normal + math.pi, math.inf, math.inf), False


_MIDDLE_RAD = math.radians(74.0)  # of an array
_PUSHES_M = 4e-3
"""How far a finger that feels nothing stays behind what is wanted: some 0.06 N on its soft link; free ones 2 mm."""
_NEAR_M, _GENTLE = 5e-3, 0.5  # how far from where it is expected a finger is slow, and by how much of the closing speed
_CREEP = 0.3  # of the closing speed, once it has met it
_FILTER_S, _RESTED_S, _UNFELT_S = 0.03, 0.1, 0.5
_BESIDE, _BESIDE_S = "OUT_OF_ARC", 0.02
_MISLEADS = {name for name, flag in Quality.__members__.items() if flag in DOUBT & ~Quality.IMPRECISE}
"""What a touch must not be; one so light is never precise."""


def _place(at: tuple[float, float]) -> str:
    return f"{1e3 * at[0]:.0f}, {1e3 * at[1]:.0f} mm"
