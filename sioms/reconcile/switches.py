"""A number that has two values and switches between them: a load that is picked up, a brake that drags for a while."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.course import Course, estimate
from sioms.reconcile.effect import Array
from sioms.reconcile.thresholds import EARNED, GAIN, REGULAR, SECOND, SURE
from sioms.reconcile.windows import NUMBERS, Number, Products, Read, View

ROUNDS, LEVELLED = 20, 3
SAID = 4  # spans of a record


@dataclass(frozen=True, slots=True)
class Switches:
    """When numbers have their second values: per record whether at first, and the samples at which that changes."""

    first: tuple[bool, ...]
    edges: tuple[tuple[int, ...], ...]

    def any(self) -> bool:
        """Say whether there are two values at all."""
        return len(set(self.first)) > 1 or any(self.edges)

    def turned(self) -> Switches:
        """Exchange first and second values."""
        return Switches(tuple(not f for f in self.first), self.edges)

    def put(self, record: int, edges: Sequence[int], first: bool) -> Switches:
        """Return other switches in one record."""
        firsts, every = list(self.first), list(self.edges)
        firsts[record], every[record] = first, tuple(edges)
        return Switches(tuple(firsts), tuple(every))

    def moved(self, step: int, ends: Sequence[int]) -> Iterator[tuple[int, int, int]]:
        """Yield record, switch and its new sample of every switch that may come a step earlier or later."""
        for i, own in enumerate(self.edges):
            for k, at in enumerate(own):
                before, after = own[k - 1] if k else 0, own[k + 1] if k + 1 < len(own) else ends[i]
                yield from ((i, k, to) for to in (at - step, at + step) if before < to < after)

    def fewer(self) -> Iterator[Switches]:
        """Yield what is left without the first or the last switch of a record, or without two that
        follow each other.
        """
        for i, (own, first) in enumerate(zip(self.edges, self.first, strict=True)):
            if own:
                yield self.put(i, own[1:], not first)
                yield self.put(i, own[:-1], first)
            for k in range(len(own) - 1):
                yield self.put(i, own[:k] + own[k + 2 :], first)

    def on(self, record: int, count: int) -> Array:
        """Return 1 where the second values hold, else 0, shape (count,)."""
        out = np.full(count, float(self.first[record]))
        for e in self.edges[record]:
            out[e:] = 1.0 - out[e]
        return out

    def continued(self, counts: Sequence[int]) -> Switches:
        """Let switches that come regularly go on to the ends of the records."""
        out = []
        for own, count in zip(self.edges, counts, strict=True):
            between, more = np.diff(own), list(own)
            if len(between) >= 2 and np.ptp(between) < REGULAR * np.mean(between):
                more += list(np.arange(own[-1], count, float(np.mean(between))).round().astype(int)[1:])
            out.append(tuple(more))
        return Switches(self.first, tuple(out))


@dataclass(frozen=True, slots=True)
class _Sized:
    """Numbers that switch.

    Attributes:
        sizes: at which the forces of the numbers are taken.
        first: values, shape (parts,), empty if they are none; added: how much the second are more; spread: standard
            deviation of that; left: squares left.
    """

    parts: tuple[Number, ...]
    sizes: tuple[float, ...]
    first: Array
    added: Array
    spread: Array
    left: float

    @classmethod
    def of(
        cls,
        view: View,
        parts: Sequence[Number],
        switches: Switches,
        sizes: Sequence[float] = (),
        steady: bool = True,
    ) -> _Sized:
        """Fit numbers; sizes that are not given are found, too."""
        k, none = len(parts), np.empty(0)
        out = cls(tuple(parts), tuple(sizes) or (0.0,) * k, none, none, none, np.inf)
        for _ in range(1 if sizes else LEVELLED):
            columns = []
            for i, r in enumerate(view.records):
                b = out.columns(view, i)
                on = b * switches.on(i, len(r))[:, None]
                columns.append(view.answer(i, np.concatenate([b, on], axis=1) if steady else on))
            size, spread, left = view.fitted(np.concatenate(columns))
            first, added = size[:-k], size[-k:]
            now = np.abs(size[:k]) > np.abs(added + first) if steady else np.zeros(k, dtype=bool)
            there = np.where(now, size[:k], added + first if steady else added)
            out = cls(out.parts, tuple(sizes) or tuple(map(float, there)), first, added, spread[-k:], left)
        return out

    def again(self, view: View, switches: Switches, steady: bool) -> _Sized:
        """Fit to another view what surely changes."""
        every = list(zip(self.parts, self.sizes, self.added, self.spread, strict=True))
        sure = [(p, s) for p, s, a, e in every if abs(a) > SURE * e] or [(p, s) for p, s, _, _ in every]
        return _Sized.of(view, [p for p, _ in sure], switches, [s for _, s in sure], steady)

    def columns(self, view: View, record: int) -> Array:
        """Forces per unit of the numbers in a record, shape (n, parts)."""
        return np.stack([view.column(record, p, s) for p, s in zip(self.parts, self.sizes, strict=True)], axis=1)


class _Trials:
    """Squares that switches leave beside numbers of given sizes; only records whose switches are new are looked at."""

    def __init__(self, view: View, sized: _Sized) -> None:
        """Look at what the numbers do in every record."""
        self.view = view
        self.forces = [sized.columns(view, i) for i in range(len(view.records))]
        self.steady = [view.answer(i, b) for i, b in enumerate(self.forces)]
        self.known: dict[tuple[int, bool, tuple[int, ...]], Products] = {}

    def left(self, switches: Switches) -> float:
        """Return the squares that are left."""
        every = enumerate(zip(switches.first, switches.edges, strict=True))
        return self.view.left([self._products(i, switches, (i, *key)) for i, key in every])

    def _products(self, i: int, switches: Switches, key: tuple[int, bool, tuple[int, ...]]) -> Products:
        if key not in self.known:
            b = self.forces[i]
            on = self.view.answer(i, b * switches.on(i, len(b))[:, None])
            self.known[key] = self.view.products(i, np.concatenate([self.steady[i], on], axis=1))
        return self.known[key]


def switching(view: View, number: Number, read: Read) -> Course | None:
    """Fit two values of a number, and of a second one that switches with it where that says much more."""
    switches = _settled(view, [number], _two_values(view, read))
    if not switches.any():
        return None
    best = _Sized.of(view, [number], switches)
    pairs = (_Sized.of(view, [number, o], switches) for o in NUMBERS if o is not number)
    both = min(pairs, key=lambda q: q.left)
    if view.above(both.left) < SECOND * view.above(best.left):
        # what the one did by more switches the other may do
        switches = _settled(view, both.parts, switches)
        best = _Sized.of(view, both.parts, switches)
    if not switches.any():
        return None
    if abs(best.first[0]) > abs(best.first[0] + best.added[0]):  # the smaller of two values is the usual one
        switches = switches.turned()
    best = _Sized.of(view, best.parts, switches)
    bare = _Sized.of(view, best.parts, switches, steady=False)
    steady = bare.left > (1.0 + GAIN) * best.left
    return _course(view, best if steady else bare, switches, steady)


def _course(view: View, sized: _Sized, switches: Switches, steady: bool) -> Course:
    parts, counts = sized.parts, [len(r) for r in view.records]
    going = switches.continued(counts)
    force = " + ".join(p.force for p in parts).replace("+ -", "- ")
    return Course(
        "switch",
        f"F = {force} while it is on",
        f"the {' and the '.join(p.text for p in parts)} switch{'es' * (len(parts) < 2)} in time, "
        f"{_when(view, switches)}",
        tuple(estimate(view, *q) for q in zip(parts, sized.added, sized.spread, strict=True)),
        tuple(going.on(i, n) * (sized.columns(view, i) @ sized.added) for i, n in enumerate(counts)),
        sized.left * len(view.residual) / len(view.rows),
        len(sized.first) + len(parts) + sum(len(e) for e in switches.edges) + len(counts),
        lambda view: _course(view, sized.again(view, switches, steady), switches, steady),
    )


def _two_values(view: View, read: Read) -> Switches:
    """Tell windows of one value from windows of another, where each switch saves more than it would of noise."""
    price = EARNED * read.left / len(view.rows)
    g, w = np.concatenate(read.values), np.concatenate(read.weights)
    order = np.argsort(g)
    share = np.cumsum(w[order]) / np.sum(w)
    low, high = (float(g[order[int(np.searchsorted(share, q))]]) for q in (0.15, 0.85))
    before: NDArray[np.bool_] = np.zeros(0, dtype=bool)
    for _ in range(ROUNDS):
        on = [_path(v, c, low, high, price) for v, c in zip(read.values, read.weights, strict=True)]
        now = np.concatenate(on)
        if now.all() or not now.any() or np.array_equal(now, before):
            break
        low, high = (float(np.average(g[s], weights=w[s])) for s in (~now, now))
        before = now
    edges = (c[1:-1][np.diff(s)] for c, s in zip(view.cuts, on, strict=True))
    return Switches(tuple(bool(s[0]) for s in on), tuple(tuple(map(int, e)) for e in edges))


def _path(value: Array, weight: Array, low: float, high: float, price: float) -> NDArray[np.bool_]:
    """Find the likeliest course of two values (A. J. Viterbi, 1967)."""
    costs = np.stack([weight * (value - low) ** 2, weight * (value - high) ** 2])
    total, back = costs[:, 0], np.zeros((2, len(value)), dtype=np.int64)
    for k in range(1, len(value)):
        other = total[::-1] + price
        back[:, k] = np.where(other < total, [1, 0], [0, 1])
        total = np.minimum(total, other) + costs[:, k]
    out = np.zeros(len(value), dtype=np.int64)
    out[-1] = int(total[1] < total[0])
    for k in range(len(value) - 1, 0, -1):
        out[k - 1] = back[out[k], k]
    return out.astype(bool)


def _settled(view: View, parts: Sequence[Number], switches: Switches) -> Switches:
    """Move every switch to where it leaves least, to a sample, and take out those that save less
    than an effect must.
    """
    if not switches.any():
        return switches
    trials = _Trials(view, _Sized.of(view, parts, switches))
    left, step, ends = trials.left(switches), 4 * view.window, [s.stop for s in view.spans]
    while step >= 1:
        for i, k, to in list(switches.moved(step, ends)):
            own = switches.edges[i]
            edges = (*own[:k], to, *own[k + 1 :])
            if edges != tuple(sorted({*edges})):
                continue
            trial = switches.put(i, edges, switches.first[i])
            if (cost := trials.left(trial)) < left:
                left, switches = cost, trial
        step //= 2
    while fewer := list(switches.fewer()):
        costs = [trials.left(t) for t in fewer]
        if min(costs) > left / (1.0 - GAIN):
            break
        left, switches = min(left, *costs), fewer[int(np.argmin(costs))]
    return switches


def _when(view: View, switches: Switches) -> str:
    """Say in which spans of which record the second values hold."""
    said = []
    every = zip(view.records, switches.first, switches.edges, view.spans, strict=True)
    for record, first, own, span in every:
        ends = [0, *own, span.stop] if first else [*own, span.stop]
        pairs = zip(ends[::2], ends[1::2], strict=False)
        spans = [f"{a * view.dt:.2f} to {b * view.dt:.2f} s" for a, b in pairs]
        if spans:
            more = f" and {len(spans) - SAID} times more" if len(spans) > SAID else ""
            said.append(f"{record.name}: {', '.join(spans[:SAID])}{more}")
    return "on in " + "; ".join(said)
