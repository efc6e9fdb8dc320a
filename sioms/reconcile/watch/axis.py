"""The watch of one axis: samples in, a verdict out, whenever some twenty seconds of motion are complete.

It learns what is normal first. Then windows of the last blocks, short and long, are judged against it. A drift is
told when a window and the judgements before it agree; a name when the same causes separate several times, else that
the cause is open.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from sioms.reconcile.thresholds import AGREE, FEWEST_BLOCKS, OPEN, OVER, SERIOUS, SERIOUS_PLACE

from .blocks import Block, Collector, Crossing
from .causes import BY_NAME, Finding, judge
from .moves import Cutter, Samples
from .normal import Normal, estimate, learn
from .rows import PLAYS, Known, rows_of

#: Blocks of the windows that are judged; the shortest comes first.
WINDOWS = (3, 6, 12, 24)
#: An edge of the reference counts where the commanded speed was the same for so long [s], within this share of it.
STEADY_S, STEADY = 0.03, 0.02
#: The speed at which it is passed is that of so long before it is told [s].
LATELY_S = 0.01
#: ... or where it was changed all the same way, by this share of the axis's speed at least: then inertia says which
#: flank of a play bears.
PUSHED_S, PUSHED = 0.04, 0.1
#: A block tells when a change began where it tells so much of it as blocks without noise would.
TELLS = 0.05
#: Blocks that are kept.
KEPT = 400


@dataclass(frozen=True, slots=True)
class About:
    """What is known of an axis beforehand.

    Attributes:
        name: of its node.
        rotary: m and N, or rad and N m.
        tick_s: period of its samples.
        force_max: limit of its drive, inf for none.
        travel: between its limits [m or rad]; step: of its encoder, 0 for unknown.
        speed: greatest [m/s or rad/s].
    """

    name: str
    rotary: bool
    tick_s: float
    force_max: float
    travel: float
    step: float
    speed: float

    def unit(self, form: str) -> str:
        """Return a unit, from a form with {x}, {F} and {m}."""
        x, force, mass = ("rad", "N m", "kg m^2") if self.rotary else ("m", "N", "kg")
        return form.format(x=x, F=force, m=mass)


@dataclass(frozen=True, slots=True)
class Settings:
    """How the watch learns.

    Attributes:
        learn_s: commissioning lasts at least so long, and learn_blocks blocks of motion.
    """

    learn_s: float = 7200.0
    learn_blocks: int = 45


@dataclass(frozen=True, slots=True)
class Drift:
    """What has changed.

    Attributes:
        names: one: it is named; several, or none: the cause is open.
        since_s: when the change began to show, of the axis's clock.
        told_s: when it was told first.
        serious: whether it is a major alarm.
    """

    names: tuple[str, ...]
    finding: Finding
    since_s: float
    told_s: float
    serious: bool

    @property
    def name(self) -> str:
        """The cause, '' where it is open."""
        return self.names[0] if len(self.names) == 1 else ""

    def text(self, about: About) -> str:
        """Say it in a sentence, without when."""
        f = self.finding
        if not self.name:
            of = f"one of: {', '.join(self.names)}" if self.names else "none that is known"
            return f"drift, cause open ({of}); it goes with the {f.ordered}, {100 * f.share:.0f} % of the usual force"
        cause = BY_NAME[self.name]
        unit = about.unit(cause.unit)
        if self.name in ("lower force", "more force"):
            size = f"{100 * f.size:.1f} % of it, {100 * f.low:.1f} to {100 * f.high:.1f} %"
        elif unit == "1":
            size = f"{100 * f.size:+.2f} %, {100 * f.low:+.2f} to {100 * f.high:+.2f} %"
        else:
            size = f"{f.size:+.3g} {unit}, {f.low:+.3g} to {f.high:+.3g}"
        return f"{cause.text}: {size}"


@dataclass(slots=True)
class AxisWatch:
    """The watch of one axis. Use from one thread.

    Attributes:
        about, settings: see there.
        known: force that the model file explains beside the columns.
        normal: None while it learns.
        blocks: the latest; all of them while it learns.
        drift: what is told at present; None: nothing.
        fastest: greatest speed so far.
        motion_s: seconds of motion that were looked at.
    """

    about: About
    settings: Settings = field(default_factory=Settings)
    known: Known | None = None
    normal: Normal | None = None
    blocks: deque[Block] = field(default_factory=lambda: deque(maxlen=KEPT))
    drift: Drift | None = None
    latest: Finding | None = None
    motion_s: float = 0.0
    _cutter: Cutter = field(init=False)
    _collector: Collector = field(default_factory=Collector)
    _agreed: deque[tuple[str, ...]] = field(default_factory=lambda: deque(maxlen=OPEN))
    _calm: int = 0
    _edges: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._cutter = Cutter(self.about.tick_s, self.about.force_max)

    def feed(self, samples: Samples, edges: Iterable[float] = ()) -> bool:
        """Take samples, and instants at which the reference changed [s]; return whether there was a judgement."""
        self._refer(samples, edges)
        judged = False
        for move in self._cutter.feed(samples):
            a = self.about
            rows = rows_of(move, a.tick_s, a.speed, PLAYS * a.travel, self.known)
            if rows is None:
                continue
            self.motion_s += rows.seconds
            block = self._collector.add(rows)
            if block is not None:
                self._take(block)
                judged = True
        return judged

    def _refer(self, samples: Samples, edges: Iterable[float]) -> None:
        """Read the place of the axis at the edges of its reference that it passes at a steady speed."""
        self._edges += edges
        if not len(samples):
            return
        last = float(samples.time_s[-1])
        for at in [e for e in self._edges if e <= last]:
            i = int(np.searchsorted(samples.time_s, at))
            if 0 < i < len(samples) and samples.time_s[i] - samples.time_s[i - 1] < 1.5 * self.about.tick_s:
                way = float(np.sign(samples.speed[i])) if self._is_steady(samples, i) else 2.0 * self._push(samples, i)
                place = float(np.interp(at, samples.time_s[i - 1 : i + 1], samples.position[i - 1 : i + 1]))
                if way:
                    self._collector.cross(Crossing(place, int(way), self._speed(samples, i)))
        self._edges = [e for e in self._edges if e > last]

    def _speed(self, samples: Samples, i: int) -> float:
        """Return the measured speed of the last moment: a short move is not as fast as it is told to be."""
        before = max(i - max(round(LATELY_S / self.about.tick_s), 2), 0)
        return float((samples.position[i] - samples.position[before]) / (samples.time_s[i] - samples.time_s[before]))

    def _is_steady(self, samples: Samples, i: int) -> bool:
        """Return whether the speed has been the same for a while: in a play the flank that bears follows from that."""
        before = max(i - round(STEADY_S / self.about.tick_s), 0)
        speed = samples.speed[before : i + 1]
        return bool(np.ptp(speed) <= STEADY * abs(float(speed[-1])))

    def _push(self, samples: Samples, i: int) -> float:
        """Return the way in which the axis has been accelerated clearly for a while; 0 where it has not."""
        before = i - max(round(PUSHED_S / self.about.tick_s), 1)
        if before < 0:
            return 0.0
        steps = np.diff(samples.speed[before : i + 1])
        gained = float(np.sum(steps))
        one_way = bool(np.all(steps * np.sign(gained) > 0.0))
        return float(np.sign(gained)) if one_way and abs(gained) > PUSHED * self.about.speed else 0.0

    def _take(self, block: Block) -> None:
        self.blocks.append(block)
        if self.normal is None:
            first = self.blocks[0].start_s
            enough = len(self.blocks) >= max(self.settings.learn_blocks, FEWEST_BLOCKS)
            if (enough and block.end_s - first >= self.settings.learn_s) or len(self.blocks) == KEPT:
                self.normal = learn(list(self.blocks), self.about.travel, self.about.step)
                self.blocks.clear()
            return
        self._judge(self.normal, block)

    def _judge(self, normal: Normal, block: Block) -> None:
        over = {w: f for w in WINDOWS if len(self.blocks) >= w and (f := self._over(normal, w)).is_drift}
        found = list(over.values())
        self.latest = found[-1] if found else self._over(normal, min(len(self.blocks), WINDOWS[-1]))
        if not found:
            self._agreed.clear()
            self._calm += 1
            if self.drift is not None and self._calm >= OVER:
                self.drift = None
            return
        self._calm = 0
        shown = next(iter(over))
        since = self._since(normal, found[-1], shown)
        if since is None:
            after = list(self.blocks)[-shown:]
            since = after[0].start_s
        else:
            after = [b for b in self.blocks if b.start_s > since][-WINDOWS[-1] :]  # in the first one it began
        if len(after) < WINDOWS[0]:
            return
        finding = self._of(normal, after)
        if not finding.is_drift:
            finding = found[-1]
        self.latest = finding
        self._agreed.append(finding.names)
        self._tell(finding, since, block.end_s)

    def _tell(self, finding: Finding, since: float, now_s: float) -> None:
        last = list(self._agreed)[-AGREE:]
        sure = len(last) == AGREE and len(set(last)) == 1 and len(finding.names) == 1
        if not sure and len(self._agreed) < OPEN:
            return
        before, names = self.drift, finding.names if sure else self._ever()
        if before is not None and before.name and not sure and set(before.names) & set(finding.names):
            names = before.names  # what has been named stands until another name is as clear, or it fits no more
        if before is not None and names == before.names:
            since = min(since, before.since_s)
        far = (
            bool(names) and names[0] in ("place", "backlash") and abs(finding.size) > SERIOUS_PLACE * self.about.travel
        )
        told = now_s if before is None else before.told_s
        self.drift = Drift(names, finding, since, told, far or finding.share > SERIOUS)

    def _ever(self) -> tuple[str, ...]:
        """Return all causes that the last judgements left open."""
        seen = dict.fromkeys(name for names in self._agreed for name in names)
        return tuple(seen) if all(self._agreed) and len(seen) > 1 else ()

    def _over(self, normal: Normal, count: int) -> Finding:
        return self._of(normal, list(self.blocks)[-count:])

    def _of(self, normal: Normal, blocks: Sequence[Block]) -> Finding:
        now = estimate(blocks, normal.loads, normal.edges, normal.scatter, normal.noise, self.about.travel)
        return judge(normal, now, self.about.travel)

    def _since(self, normal: Normal, finding: Finding, shown: int) -> float | None:
        """Return when a change began: from where on the blocks are nearer to it than to what is normal, by all that
        each tells along it.

        None where none of the last ``shown``, in which it shows, tells it by itself: the mass of the lightest move, of
        a few.
        """
        size = np.sqrt(np.diag(normal.own))
        size[size == 0.0] = 1.0  # what the axis has no reference for
        change, own = finding.change / size, normal.own / np.outer(size, size)
        most = float(change @ np.linalg.pinv(own, hermitian=True) @ change)
        sums, best, start, told = 0.0, 0.0, self.blocks[-1].start_s, False
        for number, block in enumerate(reversed(self.blocks)):
            one = estimate([block], normal.loads, normal.edges, normal.scatter, normal.noise, self.about.travel)
            weighed = np.linalg.solve(own + one.noise / np.outer(size, size), change)
            full = float(weighed @ change)
            if full > TELLS * most:
                told = told or number < shown
                along = float(weighed @ ((one.theta - normal.theta) / size))
                sums += min(max(along / full, -1.0), 2.0) - 0.5
            if sums > best:
                best, start = sums, block.start_s
        return start if told else None

    def relearn(self) -> None:
        """Forget what was normal, and learn anew."""
        self.normal = self.drift = self.latest = None
        self.blocks.clear()
        self._agreed.clear()
        self._calm = 0
