"""Numbers of the axis window by window: what each must have been while the rest of the model stayed as it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag

from sioms.reconcile.effect import Array
from sioms.reconcile.effects.smooth import DRY
from sioms.reconcile.fit import Fit, Problem
from sioms.reconcile.noise import corrections, effective_samples
from sioms.reconcile.screen import MOST_ROWS, dead_band, direction, orthonormal, smoothed_motion
from sioms.reconcile.simulate import inertia, linked, pack

#: Shortest window, and most of them.
WINDOW_S, MOST_WINDOWS = 0.1, 160
#: What keeps columns apart that are nearly the same.
RIDGE = 1e-6


@dataclass(frozen=True, slots=True)
class Seen:
    """Motion of one record, arrays of shape (n,).

    The acceleration is that of the model, not the measured one: force and measured acceleration together explain
    whatever there is, since their difference is what is unknown.

    Attributes:
        u: force of the drive; v: speed; a: acceleration of the model.
        whole: the acceleration knows of what changes.
        inertia: of the model; dead: speed below which there is no direction.
    """

    u: Array
    v: Array
    a: Array
    whole: bool
    inertia: float
    dead: float


@dataclass(frozen=True, slots=True)
class Number:
    """A number of the axis, by the force that one unit more of it makes where it is about ``size``, 0 for unknown.

    Attributes:
        effects: what its steady part is called.
    """

    symbol: str
    force: str
    unit: str
    text: str
    column: Callable[[Seen, float], Array]
    effects: tuple[str, ...] = ()


def _dry(s: Seen, size: float) -> Array:
    """Force of dry friction; at rest it holds against the drive."""
    way = direction(s.v, s.dead)
    out: Array = -way
    return out if size == 0.0 else out - (1.0 - np.abs(way)) * np.clip(s.u / abs(size), -1.0, 1.0)


def _inert(s: Seen, size: float) -> Array:
    """Force of inertia, with the acceleration that is left by it."""
    out: Array = -s.a
    return out if s.whole else out * s.inertia / max(s.inertia + size, 0.1 * s.inertia)


NUMBERS = (
    Number("g", "g u", "1", "gain of the drive", lambda s, size: s.u),
    Number("m", "-m a", "{F} s^2/{x}", "inertia", _inert, ("payload",)),
    Number("Fc", "-Fc sign(v)", "{F}", "dry friction", _dry, DRY),
    Number("c", "-c v", "{F} s/{x}", "viscous friction", lambda s, size: -s.v, ("viscous",)),
    Number("w", "w", "{F}", "constant force", lambda s, size: np.ones_like(s.v), ("offset",)),
)


@dataclass(frozen=True, slots=True)
class Read:
    """What a number was in every window: values, and their weights in squares, per record, and the squares that this
    leaves.
    """

    values: list[Array]
    weights: list[Array]
    left: float


@dataclass(frozen=True, slots=True)
class Products:
    """What columns of one record, shape (n, k), have to do with each other, with numbers of the model, and with what
    is left: shapes (k, k), (numbers, k) and (k,).
    """

    own: Array
    model: Array
    rest: Array


class View:
    """What a fit leaves; its rows are those of the residual, thinned.

    Attributes:
        rest: beside what the numbers of the model could make up for, shape (rows,).
        cuts: ends of the windows of every record, in samples.
        parts: rows of every record.
    """

    def __init__(self, problem: Problem, fit: Fit, forces: Sequence[Array] = ()) -> None:
        """Look at a fit.

        Args:
            forces: of every record, shape (n,), known to the problem, and so to the acceleration, that are to be looked
                at with the rest.
        """
        self.problem, self.model, self.residual = problem, fit.model, fit.residual
        self.records, self.dt = problem.session.records, fit.model.sample_time_s
        self.spans = [range(len(r))[problem.span(r)] for r in self.records]
        total = sum(len(s) for s in self.spans)
        self.step = max(total // MOST_ROWS, 1)
        first = np.cumsum([0, *(len(s) for s in self.spans)])
        self.rows = np.concatenate(
            [a + np.arange(0, len(s), self.step) for a, s in zip(first, self.spans, strict=False)]
        )
        ends = np.cumsum([0, *(len(range(0, len(s), self.step)) for s in self.spans)]).tolist()
        self.parts = [slice(a, b) for a, b in pairwise(ends)]
        self.seen = _seen(problem, fit, bool(forces))
        self.factors = np.broadcast_to(problem.factors, len(fit.residual))[self.rows]
        self.q = orthonormal(fit.jacobian[self.rows])
        rest = fit.residual[self.rows]
        if forces:
            shown = np.concatenate([self.answer(i, f) for i, f in enumerate(forces)])
            rest = rest + shown * self.factors
        self.rest = self._beside(rest)
        self.window = max(round(WINDOW_S / self.dt), total // MOST_WINDOWS)
        self.cuts = [np.linspace(s.start, s.stop, max(len(s) // self.window, 1) + 1).astype(int) for s in self.spans]

    def _beside(self, columns: Array) -> Array:
        out: Array = columns - self.q @ (self.q.T @ columns)
        return out

    def column(self, record: int, number: Number, size: float = 0.0) -> Array:
        """Return the force per unit of a number in a record, shape (n,)."""
        return number.column(self.seen[record], size)

    def answer(self, record: int, force: Array) -> Array:
        """Pass forces in one record, shape (n,) or (n, k), into the rows of that record."""
        span = self.spans[record]
        e = self.problem.answer(self.model, force)[span.start : span.stop : self.step]
        out: Array = e / self.problem.noise.innovation
        return out

    def fitted(self, columns: Array) -> tuple[Array, Array, float]:
        """Fit what is left by columns of all rows, shape (rows, k).

        Returns:
            Sizes and their standard deviations, shape (k,), and the squares that this leaves.
        """
        f = self._beside(columns * self.factors[:, None])
        scale = np.maximum(np.linalg.norm(f, axis=0), 1e-300)
        gram = (f / scale).T @ (f / scale) + RIDGE * np.eye(f.shape[1])
        size = np.linalg.solve(gram, (f / scale).T @ self.rest)
        rest = self.rest - (f / scale) @ size
        left = float(rest @ rest)
        spread = np.sqrt(np.diag(np.linalg.inv(gram)) * left / effective_samples(rest))
        return size / scale, spread / scale, left

    def products(self, record: int, columns: Array) -> Products:
        """Multiply columns of the rows of one record, shape (n, k), out."""
        part = self.parts[record]
        f = columns * self.factors[part][:, None]
        return Products(f.T @ f, self.q[part].T @ f, f.T @ self.rest[part])

    def left(self, products: Sequence[Products]) -> float:
        """Return the squares that a fit leaves, as ``fitted`` does, from the products of all records."""
        own, model, rest = (np.sum([getattr(p, name) for p in products], axis=0) for name in ("own", "model", "rest"))
        gram = own - model.T @ model
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        gram, toward = gram / np.outer(scale, scale), rest / scale
        size = np.linalg.solve(gram + RIDGE * np.eye(len(gram)), toward)
        return float(self.rest @ self.rest - 2.0 * size @ toward + size @ gram @ size)

    def above(self, squares: float) -> float:
        """Squares above what noise leaves."""
        return max(squares - len(self.rows), 0.0)

    def read(self, number: Number) -> Read | None:
        """Read off what a number must have been in every window; None where nothing shows."""
        blocks = []
        for i, cuts in enumerate(self.cuts):
            b = self.column(i, number)
            columns = np.zeros((len(b), len(cuts) - 1))
            for k, (start, stop) in enumerate(pairwise(cuts)):
                columns[start if k else 0 : stop, k] = b[start if k else 0 : stop]
            blocks.append(self.answer(i, columns))
        f = block_diag(*blocks)
        if not np.any(f):
            return None
        value, spread, left = self.fitted(f)
        weight = left / len(self.rows) / np.clip(spread, 1e-150, 1e150) ** 2
        ends = np.cumsum([len(c) - 1 for c in self.cuts])[:-1]
        return Read(np.split(value, ends), np.split(weight, ends), left)


def _seen(problem: Problem, fit: Fit, whole: bool) -> list[Seen]:
    dt, dead, packed = fit.model.sample_time_s, dead_band(problem, fit.model), pack(fit.model)
    corrected = corrections(problem.noise, linked(packed), dt)[1]
    out = []
    for run, m in zip(problem.runs(fit.model), smoothed_motion(problem, fit.model), strict=True):
        # without what the observer corrects
        a = (run.v[1:] - corrected * run.innovation[1:] - run.v[:-1]) / dt
        out.append(Seen(m.u, m.v, np.append(a, a[-1]), whole, inertia(packed), dead))
    return out
