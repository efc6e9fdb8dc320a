"""The evidence in recorded grasps: rows by view, their noise, and what is fitted along without a name.

Views: closure along and across the line of contacts, the angle between a bar's two sides, the deflection of both
drives, the balance of both loads (without wrists), loads against wrists, and where slips begin. Fitted along and
projected out, in every recording anew: where module 2 stands against module 1, the zeros of both revolute joints and of
their commands, and the force of the platen on the object along the line of contacts; in all together, a ripple of the
places with the period of the elements, and sizes that are not known.

The noise of a row follows from that of everything that was read, by differences.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.hand.belief import Gaps, HandBelief, direction, gaps, line_of, touched
from sioms.reconcile.hand.grasps import OTHER, Floats, Grasps, Ints
from sioms.reconcile.hand.model_file import Noise
from sioms.reconcile.sensors.effect import SensorModel

VIEWS = ("along", "across", "normals", "drive", "balance", "wrist", "slip")
UNITS = ("m", "m", "rad", "rad", "1", "1", "1")
LEAST_ROWS = 10  # of a view
SOFT = 0.15  # by which the softness of the rubber may be off
TINY = {"m": 1e-6, "rad": 1e-6, "1": 1e-4}
LIGHT_N = 0.05  # loads below tell nothing of ratios
#: Each row's place in the grasps and which finger of the pair it is of.
Place = tuple[Ints, Ints]


def stacked(found: Gaps) -> list[Floats]:
    """Return gaps by view, a pair as one column after the other: shape (n, k) each."""
    out = [getattr(found, name) for name in VIEWS]
    return [v[:, None] if v.ndim == 1 else v for v in out]


@dataclass(frozen=True, eq=False)
class HandData:
    """Rows of recorded grasps; see ``sensors.fit.Data``.

    Attributes:
        grasps: which count; axis: direction to which the closure refers [rad], shape (n,).
        places: rows of each view, in the order of time; views: their names.
        sigma: noise of each row, shape (rows,).
        block: see ``Data``.
        along: change of every row with what is fitted along, in units of the noise, orthonormal, shape (rows, k).
    """

    grasps: Grasps
    axis: Floats
    places: tuple[Place, ...]
    views: tuple[str, ...]
    sigma: Floats
    block: NDArray[np.int64]
    along: Floats

    @cached_property
    def view(self) -> NDArray[np.int64]:
        """View of each row."""
        return np.repeat(np.arange(len(self.views)), [len(p[0]) for p in self.places])

    @cached_property
    def element(self) -> NDArray[np.int64]:
        """None: rows mix both fingers."""
        return np.full(len(self.view), -1)

    @property
    def footing(self) -> tuple[int, ...]:
        """Every view stands on its own."""
        return tuple(range(len(self.views)))

    @cached_property
    def row(self) -> Ints:
        """Row of the grasps of each row."""
        return np.concatenate([p[0] for p in self.places])

    def predict(self, model: SensorModel) -> Floats:
        """Return the gaps in units of their noise."""
        return self.gathered(model.belief(), self.grasps) / self.sigma

    def gathered(self, b: HandBelief, g: Grasps, stray: Floats | None = None) -> Floats:
        """Return the gaps of all rows, shape (rows,)."""
        found = dict(zip(VIEWS, stacked(gaps(b, g, self.axis, stray)), strict=True))
        return np.concatenate([found[name][p] for name, p in zip(self.views, self.places, strict=True)])

    def miss(self, predicted: Floats) -> Floats:
        """Return the gaps, what is fitted along projected out: they should be none."""
        return self.whiten(predicted)

    def whiten(self, change: Floats) -> Floats:
        """Project out what is fitted along, shape (rows,) or (rows, k)."""
        return np.asarray(change - self.along @ (self.along.T @ change))

    def doubts(self, model: SensorModel) -> Floats:
        """Return what other rubber would change, shape (rows, 1)."""
        b: HandBelief = model.belief()
        softer = replace(b, soft=b.soft * (1.0 + SOFT))
        return np.asarray((self.gathered(softer, self.grasps) - self.gathered(b, self.grasps)) / self.sigma)[:, None]

    def independent(self) -> tuple[NDArray[np.int64], Floats]:
        """Return the grasp of each row: its rows of all views are of the same readings; and what is fitted along."""
        return np.unique(self.grasps.grasp[self.row], return_inverse=True)[1], self.along

    def with_sigma(self, sigma: Floats) -> HandData:
        """Return the rows with another noise."""
        along = orthonormal(self.along * (self.sigma / sigma)[:, None])
        return replace(self, sigma=sigma, along=along)

    def of_grasps(self, which: NDArray[np.bool_]) -> HandData:
        """Return the rows of some grasps, by a mask over the rows of the grasps."""
        new = np.cumsum(which) - 1
        kept = [which[p[0]] for p in self.places]
        rows = np.concatenate(kept)
        places = tuple((new[p[0][k]], p[1][k]) for p, k in zip(self.places, kept, strict=True))
        block = np.unique(self.block[rows], return_inverse=True)[1]
        return replace(
            self, grasps=self.grasps.rows(which), axis=self.axis[which], places=places, sigma=self.sigma[rows],
            block=block, along=orthonormal(self.along[rows]),
        )  # fmt: skip


def rows_of(g: Grasps, b: HandBelief, noise: Noise, guessed: Sequence[int] = ()) -> HandData:
    """Lay recorded grasps out as rows; views of too few rows are left out.

    Args:
        guessed: objects whose size is fitted along.
    """
    t = touched(b, g)
    axis = line_of(g, t.contact, direction(t.normal))
    light = np.any(t.press < LIGHT_N, axis=1)
    places, views = [], []
    for name, values in zip(VIEWS, stacked(gaps(b, g, axis)), strict=True):
        told = np.isfinite(values)
        if name in ("balance", "wrist", "slip"):
            told &= ~light[:, None]
        if np.count_nonzero(told) >= LEAST_ROWS:
            row, column = np.nonzero(told)
            places.append((row, column))
            views.append(name)
    count = sum(len(p[0]) for p in places)
    block = _blocks(g, [p[0] for p in places])
    data = HandData(g, axis, tuple(places), tuple(views), np.ones(count), block, np.zeros((count, 0)))
    sigma = _noise(data, b, noise)
    free = np.stack(list(_along(data, b, guessed)), axis=1)
    return replace(data, sigma=sigma, along=orthonormal(free / sigma[:, None]))


def _blocks(g: Grasps, rows: list[Ints]) -> NDArray[np.int64]:
    """Return the block of each row: a grasp of one view."""
    out, first = [], 0
    for row in rows:
        own = np.unique(g.grasp[row], return_inverse=True)[1]
        out.append(own + first)
        first += int(own.max()) + 1
    return np.concatenate(out)


def orthonormal(columns: Floats, alike: float = 1e-6) -> Floats:
    """Return an orthonormal basis of some columns.

    Args:
        alike: singular values below this share of the largest are left out: those columns hardly differ from others.
    """
    size = np.linalg.norm(columns, axis=0)
    live = columns[:, size > 1e-9] / size[size > 1e-9]
    if not live.shape[1]:
        return np.zeros((len(columns), 0))
    u, s, _ = np.linalg.svd(live, full_matrices=False)
    return np.asarray(u[:, s > alike * s[0]])


def _noise(data: HandData, b: HandBelief, noise: Noise) -> Floats:
    """Return the noise of each row by differences in everything that was read."""
    g, n = data.grasps, len(data.grasps)
    base = data.gathered(b, g)
    squares: list[Floats] = []

    def add(change: Floats) -> None:
        squares.append(np.nan_to_num(change - base) ** 2)

    for i in range(2):
        own = np.eye(2)[i]
        for k, step in enumerate((noise.joint_m, noise.joint_m, noise.joint_rad)):
            add(data.gathered(b, g.moved("joints", step * np.eye(6)[3 * i + k])))
        add(data.gathered(b, g.moved("place", noise.place_rad * own)))
        size = np.hypot(noise.load_n, noise.load_share * g.load[:, i])
        add(data.gathered(b, g.moved("load", size[:, None] * own)))
        for way in np.eye(2):
            pull = np.zeros((n, 2, 2))
            pull[:, i] = np.where(g.weighed, noise.wrist_n, noise.platen_n / np.sqrt(2.0))[:, None] * way
            add(data.gathered(b, g, None if not pull.any() else pull))
    if "balance" in data.views:
        add(base + _in_view(data, "balance", noise.platen_n / np.maximum(np.min(g.load, axis=1), LIGHT_N)))
    if "slip" in data.views:
        add(base + _in_view(data, "slip", np.full(n, noise.friction_share)))
    return np.asarray(np.sqrt(np.maximum(np.sum(squares, axis=0), _least(data) ** 2)))


def _least(data: HandData) -> Floats:
    """Return the least noise of each row that makes sense."""
    units = dict(zip(VIEWS, UNITS, strict=True))
    return np.array([TINY[units[name]] for name in data.views])[data.view]


def _in_view(data: HandData, name: str, values: Floats) -> Floats:
    """Return values of grasps in the rows of one view, zero in all others."""
    mine = data.view == data.views.index(name)
    return np.where(mine, values[data.row], 0.0)


def _along(data: HandData, b: HandBelief, guessed: Sequence[int]) -> Iterator[Floats]:
    """Yield the changes of the rows with what is fitted along."""
    g = data.grasps
    base = data.gathered(b, g)

    def slope(what: str, column: Floats, step: float) -> Floats:
        moved = replace(g, **{name: getattr(g, name) + step * column for name in what.split()})
        return np.asarray(np.nan_to_num(data.gathered(b, moved) - base) / step)

    for record in np.unique(g.record):
        own = (g.record == record).astype(np.float64)[:, None]
        for joint, step in ((2, 1e-4), (3, 1e-5), (4, 1e-5), (5, 1e-4)):
            yield slope("joints command", own * np.eye(6)[joint], step)
        if "drive" in data.views:
            for joint in (2, 5):
                yield slope("command", own * np.eye(6)[joint], 1e-4)
        if "balance" in data.views:
            yield _in_view(data, "balance", own[:, 0] / np.maximum(np.min(g.load, axis=1), LIGHT_N))
        if not g.weighed.all():  # the platen's force along the line of contacts, alike in all rows
            pull = np.zeros((len(g), 2, 2))
            pull[:, 0] = pull[:, 1] = direction(data.axis) * own * ~g.weighed[:, None]
            yield np.nan_to_num(data.gathered(b, g, 1e-3 * pull) - base) / 1e-3
    for i in range(2):
        wave = 2.0 * np.pi / b.pitch * g.place[:, i, None]
        for ripple in (np.sin(wave), np.cos(wave)):
            yield slope("place", ripple * np.eye(2)[i], 1e-4)
    for thing in guessed:
        yield slope("size", (g.thing == thing).astype(np.float64), 1e-5)


def sized(g: Grasps, b: HandBelief) -> tuple[Grasps, tuple[int, ...]]:
    """Give disks and bars of unknown size one that closes their grasps in the middle; return which they are, too."""
    unknown = ~g.known & (g.kind != OTHER)
    things = tuple(int(i) for i in np.unique(g.thing[unknown]))
    size = np.where(unknown, 0.02, g.size)
    for _ in range(3 if things else 0):
        off, more = (gaps(b, replace(g, size=size + by)).along for by in (0.0, 1e-5))
        for thing in things:
            mine = g.thing == thing
            step = 1e-5 * np.median(off[mine]) / np.median(more[mine] - off[mine])
            size = np.where(mine, np.maximum(size - step, 1e-3), size)
    return replace(g, size=size), things
