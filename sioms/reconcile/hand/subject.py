"""Prepare recorded grasps for the workflow: rows, their noise as the records show it, and what the report wants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.effect import TERM_PREFIX
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.hand.belief import settles
from sioms.reconcile.hand.doubts import cancelling, doubted, overlooked, slight, unsure
from sioms.reconcile.hand.grasps import Floats, Grasps
from sioms.reconcile.hand.model_file import Noise
from sioms.reconcile.hand.plan import propose
from sioms.reconcile.hand.records import check
from sioms.reconcile.hand.rows import UNITS, VIEWS, HandData, orthonormal, rows_of, sized
from sioms.reconcile.refuse import hats, knots
from sioms.reconcile.sensors.analyse import Options, analyse
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.screen import screening_columns
from sioms.reconcile.sensors.subject import Variable, View
from sioms.reconcile.sensors.verdict import Curve, Proposal, SensorVerdict
from sioms.reconcile.verdict import NamedEffect

TITLES = {
    "along": "closure along the line",
    "across": "closure across the line",
    "normals": "sides of a bar",
    "drive": "deflection of the drives",
    "balance": "ratio of both loads",
    "wrist": "ratio of load and wrist",
    "slip": "ratio of friction",
}
SPANNED = 1e-2  # share of what is fitted that is no further number
LEAST_FREE = 20  # rows of a view beyond what is fitted that tell its scatter
TAILS = 1.5  # times the middle of what is left that its root mean square may be, and still be noise
ROUNDS = 4  # searches without effects that are too small to be named
LEAST, WORST = 0.5, 3.0  # times its stated noise that a view may scatter


@dataclass(frozen=True, slots=True)
class HandSubject:
    """A prepared hand; see ``sensors.analyse.Subject``."""

    whole: HandData
    training: HandData
    final: HandData
    model: SensorModel
    noise: Noise
    notes: tuple[str, ...]
    names: tuple[str, ...] = ()
    terms: tuple[str, ...] = ()
    settled: tuple[NamedEffect, ...] = ()
    scatter: tuple[float, ...] = ()
    """By how many times its stated noise each view is taken to scatter."""

    def views(self) -> Mapping[str, View]:
        """Gaps in their own units."""
        d, units = self.whole, dict(zip(VIEWS, UNITS, strict=True))
        return {
            name: View(TITLES[name], units[name], float(np.sqrt(np.mean(d.sigma[d.view == i] ** 2))))
            for i, name in enumerate(d.views)
        }

    def features(self) -> Mapping[int, Floats]:
        """Columns of the state, by the number of the view."""
        d = self.training
        out = {}
        for i in range(len(d.views)):
            row, column = d.places[i]
            states = list(state(d.grasps, d.axis).values())
            columns = [hats(v[row], knots(v[row], 6)) for v in states if np.ptp(v[row]) > 0.0]
            for side in np.unique(column):
                own = (column == side)[:, None]
                columns += [own * hats(v[row], knots(v[row], 4)) for v in states if np.ptp(v[row]) > 0.0]
            mine = d.view == i
            full = np.concatenate(columns, axis=1) / d.sigma[mine, None]
            out[i] = full - full.mean(0)
        return out

    def groups(self) -> NDArray[np.int64]:
        """Number of the grasp of each row of the first view."""
        d = self.training
        return np.unique(d.grasps.grasp[d.places[0][0]], return_inverse=True)[1].astype(np.int64)

    def variables(self, d: HandData) -> Sequence[Variable]:
        """What a disagreement may go with."""
        units = {"time": "s", "psi": "rad", "phi1": "rad", "phi2": "rad", "load": "N", "size": "m"}
        return [
            Variable(name, units.get(name, "1"), i, values[d.places[i][0]])
            for i in range(len(d.views))
            for name, values in state(d.grasps, d.axis).items()
        ]

    def sharpened(self, model: SensorModel, shares: Mapping[int, float]) -> HandSubject | None:
        """Return None: the noise is told beside all effects and terms already, at least half the stated one."""
        return None

    def propose(self, models: Sequence[SensorModel]) -> tuple[Proposal, ...]:
        """Rank programmes of grasps by how far the models differ on them."""
        return propose(models, self.model, self.noise)

    def curves(self, before: SensorModel, after: SensorModel) -> tuple[Curve, ...]:
        """Gaps of the views that disagreed most."""
        d, units = self.whole, dict(zip(VIEWS, UNITS, strict=True))
        old, new = (d.miss(d.predict(m)) for m in (before, after))
        size = [float(np.mean(old[d.view == i] ** 2)) for i in range(len(d.views))]
        apart = untouched(d.grasps)
        out = []
        for i in np.argsort(-np.array(size))[:3]:
            mine, row = d.view == i, d.places[i][0]
            # what is measured is 0: drawn is what the nominal model leaves, and what the change explains of it
            left, told = old[mine] * d.sigma[mine], (old - new)[mine] * d.sigma[mine]
            order = np.argsort(told, kind="stable")
            count = np.arange(len(row), dtype=np.float64)
            said = "rows, by what the corrected model explains"
            at = units[d.views[i]], count, left[order], np.zeros(len(row)), told[order], apart[row][order]
            out.append(Curve(TITLES[d.views[i]], said, *at))
        return tuple(out)

    def unit(self, effect: str, symbol: str) -> str:
        """Return the unit of a parameter."""
        return next(q.unit for q in self.model.library[effect].parameters if q.symbol == symbol)


def state(g: Grasps, axis: Floats) -> dict[str, Floats]:
    """Return what a disagreement may go with, by name, shape (n,) each."""
    phi = axis[:, None] - g.joints.reshape(-1, 2, 3)[..., 2] + np.array([0.0, np.pi])
    phi = (phi + 0.5 * np.pi) % (2.0 * np.pi) - 0.5 * np.pi
    return {
        "time": g.time, "psi": axis, "phi1": phi[:, 0], "phi2": phi[:, 1], "place1": g.place[:, 0],
        "place2": g.place[:, 1], "load": g.load.mean(1), "size": np.nan_to_num(g.size),
    }  # fmt: skip


def untouched(g: Grasps) -> NDArray[np.bool_]:
    """Say which rows take no part in any choice: those of every fifth grasp."""
    number = np.unique(g.grasp, return_inverse=True)[1]
    return np.asarray(number % 5 == 2)


def scatter(d: HandData, model: SensorModel) -> Floats:
    """Return by how many times its noise each view scatters beside all effects and terms together, shape (views,)."""
    left = d.miss(d.predict(model))
    bare = replace(model, effects={})
    columns = np.concatenate([screening_columns(d, bare, e) for e in model.library.values()], axis=1)
    out = np.ones(len(d.views))
    for i in range(len(d.views)):
        mine = d.view == i
        basis = orthonormal(columns[mine], SPANNED)
        freedom = int(mine.sum()) - basis.shape[1] - d.along.shape[1]
        if freedom < max(LEAST_FREE, 0.3 * mine.sum()):
            continue
        rest = left[mine] - basis @ (basis.T @ left[mine])
        middle = 1.4826 * float(np.median(np.abs(rest)))
        whole = float(np.sqrt(np.mean(rest**2)))  # of light and heavy grasps together the noise has long tails
        out[i] = np.clip(whole, middle, TAILS * middle) * np.sqrt(mine.sum() / freedom)
    return out


def _parts(d: HandData) -> tuple[HandData, HandData, HandData]:
    """Return all rows, those of the search, and those that take no part in it."""
    mine = untouched(d.grasps)
    return d, d.of_grasps(~mine), d.of_grasps(mine)


def prepare(grasps: Grasps, model: SensorModel, noise: Noise | None = None) -> HandSubject:
    """Check recorded grasps and lay them out.

    Args:
        noise: of what was read; the usual one by default.

    Raises:
        BadInputError: they cannot be used; the message says why.
    """
    noise = noise or Noise()
    belief = model.belief()
    grasps, guessed = sized(grasps, belief)
    notes = check(grasps, belief)
    steady = settles(belief, grasps)
    if not steady.all():
        notes.append(
            f"{int(np.sum(~steady))} rows are left out: their joints are too soft for loads to tell the forces; record "
            "the wrists' forces, lighter grasps, or larger objects"
        )
        grasps = grasps.rows(steady)
        check(grasps, belief)
    if guessed:
        notes.append(f"{len(guessed)} objects are of unknown size, which is fitted along")
    d = rows_of(grasps, belief, noise, guessed)
    if not d.views:
        raise BadInputError("read grasps: no view has rows enough; record disks or bars, or commands, or slips")
    scale = np.clip(scatter(d, model), LEAST, WORST)
    for name, s in zip(d.views, scale, strict=True):
        if s > 1.5:
            notes.append(f"the {TITLES[name]} scatters {s:.2g} times as much as the stated noise makes it")
    d = d.with_sigma(d.sigma * scale[d.view])
    names = tuple(n for n, e in model.library.items() if e.rankable and not n.startswith(TERM_PREFIX))
    terms = tuple(n for n in model.library if n.startswith(TERM_PREFIX))
    return HandSubject(*_parts(d), model, noise, tuple(notes), names, terms, (), tuple(scale.tolist()))


def reconcile(
    grasps: Grasps, model: SensorModel, noise: Noise | None = None, options: Options | None = None
) -> SensorVerdict:
    """Prepare and analyse one hand.

    Raises:
        BadInputError: the records cannot be used.
    """
    subject = prepare(grasps, model, noise)
    verdict = analyse(subject, options)
    for _ in range(ROUNDS):  # what is left of one may look like another
        dropped = slight_ones(subject, verdict)
        if not dropped:
            break
        library = {name: effect for name, effect in subject.model.library.items() if name not in dropped}
        subject = replace(
            subject, model=replace(subject.model, library=library),
            names=tuple(name for name in subject.names if name not in dropped),
            notes=(*subject.notes, *dropped.values()),
        )  # fmt: skip
        verdict = analyse(subject, options)
    said = unsure(doubted(verdict, subject.whole, subject.propose), subject.whole, subject.propose)
    said = overlooked(said, subject.whole, subject.scatter, subject.propose)
    return cancelling(said, subject.whole, subject.scatter, subject.propose)


def slight_ones(subject: HandSubject, v: SensorVerdict) -> dict[str, str]:
    """Return the named effects that change no row by as much as one reading of it is stated to scatter, and say so.

    What all rows have alike, an estimator's bias or a sensor's own scale, is within that and looks like a small effect.
    """
    found = dict[str, str]()
    for effect in v.effects:
        if slight(subject.whole, subject.scatter, v.model, effect.name):
            told = ", ".join(f"{p.symbol} {p.value:.2g}" for p in effect.parameters)
            found[effect.name] = f"{effect.title} ({told}) is within the stated noise of every row: not named"
    return found
