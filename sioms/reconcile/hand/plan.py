"""Programmes of grasps that would decide between models: what a nominal hand would read, and how far models differ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from sioms.reconcile.hand.belief import HandBelief, direction, gaps, touched
from sioms.reconcile.hand.grasps import BAR, DISK, Floats, Grasps
from sioms.reconcile.hand.model_file import Noise
from sioms.reconcile.hand.rows import rows_of
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.verdict import Proposal

MIDDLE = 0.5 * np.pi


@dataclass(frozen=True, slots=True)
class Plan:
    """A programme of grasps; every combination is made.

    Attributes:
        objects: kind and size [m]; psi: directions of the line of contacts [rad]; phi: both fingers' angles [rad].
        loads: [N]; wrist: whether the wrists are read; slips: fingers that are made to slide in turn.
    """

    name: str
    text: str
    objects: tuple[tuple[int, float], ...]
    psi: tuple[float, ...]
    phi: tuple[tuple[float, float], ...]
    loads: tuple[float, ...]
    wrist: bool = False
    slips: bool = False


SIZES = ((DISK, 0.012), (DISK, 0.03), (BAR, 0.03))
WAYS = (-1.0, 0.0, 1.0)
ROLLED = ((MIDDLE, MIDDLE), (1.1, 2.0), (2.0, 1.1), (1.1, 1.1), (2.0, 2.0))
LOADS = (0.5, 1.0, 2.0)
CATALOGUE = (
    Plan("sizes", "disks of two sizes or more and a bar, in three directions psi, both fingers rolled apart",
         SIZES, WAYS, ROLLED, (1.0,)),
    Plan("loads", "one object under three loads, both fingers rolled apart", SIZES[1:2], WAYS, ROLLED, LOADS),
    Plan("wrists", "one object under three loads, the wrists' forces recorded", SIZES[1:2], WAYS, ROLLED, LOADS, True),
    Plan("slips", "slips of both fingers under loads of 0.3 to 4 N", SIZES[1:2], WAYS, ROLLED[:1], (0.3, 1.0, 4.0),
         slips=True),
)  # fmt: skip


def propose(models: Sequence[SensorModel], nominal: SensorModel, noise: Noise) -> tuple[Proposal, ...]:
    """Rank the programmes by how far the models differ on them, each pair counted by its worst; best first."""
    if len(models) < 2:
        return ()
    found = []
    for plan in CATALOGUE:
        data = rows_of(nominal_grasps(nominal.base, plan), nominal.base, noise)
        said = [data.miss(data.predict(m)) for m in models]
        apart = min(float(np.linalg.norm(a - b)) for i, a in enumerate(said) for b in said[i + 1 :])
        found.append(Proposal(plan.name, plan.text, apart / np.sqrt(len(data.view))))
    return tuple(sorted(found, key=lambda p: -p.separation))


def nominal_grasps(b: HandBelief, plan: Plan) -> Grasps:
    """Return what a hand that is as believed would read in a programme."""
    rows = list(_settings(plan))
    n = len(rows)
    kind, size, psi, phi, load = (np.array(v) for v in zip(*rows, strict=True))
    g = Grasps(
        time=10.0 * np.arange(n, dtype=np.float64), record=np.zeros(n, dtype=np.int64),
        grasp=np.arange(n), kind=kind.astype(np.int64), thing=np.unique(size, return_inverse=True)[1].astype(np.int64),
        size=size, command=np.zeros((n, 6)), joints=np.zeros((n, 6)), place=phi, load=np.stack([load, load], axis=1),
        wrist=np.full((n, 2, 2), np.nan), slip=1 + np.arange(n) % 2 if plan.slips else np.zeros(n, dtype=np.int64),
    )  # fmt: skip
    th = psi[:, None] - phi + np.array([0.0, np.pi])
    g = _closed(b, replace(g, joints=_laid(b, g, psi, th)), psi)
    t = touched(b, g)
    command = g.joints.copy()
    command[:, [2, 5]] -= t.torque / b.drive
    return replace(g, command=command, wrist=t.force if plan.wrist else g.wrist)


def _settings(plan: Plan) -> Iterator[tuple[float, float, float, tuple[float, float], float]]:
    for (kind, size), psi, phi, load in product(plan.objects, plan.psi, plan.phi, plan.loads):
        yield kind, size, psi, phi, load


def _laid(b: HandBelief, g: Grasps, psi: Floats, th: Floats) -> Floats:
    """Lay the joints so that rigid fingers touch the object on a line through its middle."""
    reach = b.finger + np.where(g.kind == DISK, g.size, 0.5 * g.size)
    way = direction(psi)
    out = np.empty((len(g), 2, 3))
    for i, sign in enumerate((-1.0, 1.0)):
        out[:, i, :2] = sign * reach[:, None] * way - b.link[i] * direction(th[:, i])
        out[:, i, 2] = th[:, i]
    return out.reshape(-1, 6)


def _closed(b: HandBelief, g: Grasps, psi: Floats) -> Grasps:
    """Move the carriages and turn the links until the forces that bend them leave the grasp closed."""
    for _ in range(4):
        t = touched(b, g)
        turned = g.joints.reshape(-1, 2, 3).copy()
        turned[..., 2] = (psi[:, None] - g.place + np.array([0.0, np.pi])) - t.torque / b.joint
        g = replace(g, joints=turned.reshape(-1, 6))
        off = gaps(b, g, psi)
        move = direction(psi) * off.along[:, None] + direction(psi + MIDDLE) * np.nan_to_num(off.across)[:, None]
        turned[:, 1, :2] -= move
        g = replace(g, joints=turned.reshape(-1, 6))
    return g
