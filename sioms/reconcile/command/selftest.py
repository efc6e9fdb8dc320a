"""``sioms reconcile selftest``: generate axes with hidden effects, solve them blind, print the figures.

The generator and the truth live in this process; every axis is solved by a process of its own that is given a
folder with the public part only.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from sioms.reconcile.command.blind import MIXTURE, in_turn, judge_all, solve
from sioms.reconcile.files.axis import read_model
from sioms.reconcile.model import AxisModel
from sioms.reconcile.simulate import simulate
from sioms.reconcile_selftest.axis import Axis
from sioms.reconcile_selftest.commands import commands
from sioms.reconcile_selftest.draw import CONFOUNDED, NAMED, NAMELESS, UNMET, draw_axis
from sioms.reconcile_selftest.near import NEAR
from sioms.reconcile_selftest.score import Scored, score
from sioms.reconcile_selftest.world import Recording, World

RECORD_S = 5.0
SETTLED_S = 0.2
COLUMNS = """[columns]
time = { name = "time", unit = "s" }
position = { name = "counts", unit = "count" }
command = { name = "command" }
force = { name = "force" }
"""
CURRENT, MARKS = 'force_measured = { name = "force_measured" }\n', 'index = { name = "index" }\n'


def generate(count: int, seed: int, near: bool = False) -> list[Axis]:
    """Draw the axes of a test; every effect comes up in turn.

    Args:
        near: hide forms near those of the library, and nothing else, on all of them.
    """
    rng = np.random.default_rng(seed)
    effects = {"single": NAMED, "unknown": (*NAMELESS, *UNMET), "confounded": CONFOUNDED, "near": NEAR}
    drawn = in_turn(count, rng, effects, ("near",) if near else MIXTURE)
    return [draw_axis(f"axis{i:03d}", kind, rng, only) for i, kind, only in drawn]


def record(axis: Axis, seconds: float = RECORD_S, heldout: bool = False) -> list[Recording]:
    """Record an axis.

    Args:
        heldout: go on with a fifth record of another command, and the same once more without noise.

    Returns:
        Its four recordings, or six.
    """
    world, orders = World(axis), commands(axis, seconds)
    runs = [world.record(order) for order in orders[:4]]
    if heldout:
        heat = world.heat
        runs.append(world.record(orders[4]))
        world.heat = heat
        runs.append(world.record(orders[4], noise=0.0))
    return runs


def closed(folder: Path, records: list[Recording]) -> float | None:
    """Measure the share of the gap in force that the model of an answer closes on the held-out command.

    Returns:
        (nominal - model)/(nominal - truth), the truth being the generator itself without noise; None where the gap is
        hardly larger than what that leaves.
    """
    models = [read_model(folder / f) for f in ("nominal.toml", "report/model.toml")]
    settled = round(SETTLED_S / models[0].sample_time_s)
    truth = float(np.sqrt(np.mean((records[4].force - records[5].force)[settled:] ** 2)))
    nominal, model = (_error(m, records, settled) for m in models)
    return (nominal - model) / (nominal - truth) if nominal > 1.2 * truth else None


def _error(model: AxisModel, records: list[Recording], settled: int) -> float:
    heat = 0.0
    for r in records[:4]:
        heat = simulate(model, r.command, heat).end_temperature
    run = simulate(model, records[4].command, heat)
    return float(np.sqrt(np.mean(np.nan_to_num(run.force - records[4].force, nan=1e9)[settled:] ** 2)))


def write_public(axis: Axis, recordings: list[Recording], folder: Path) -> None:
    """Write what the solver may see: records, column description and nominal model."""
    folder.mkdir(parents=True)
    for i, r in enumerate(recordings):
        seen: dict[str, Any] = {
            "time": np.arange(len(r.counts)) * axis.sample_s,
            "counts": r.counts,
            "command": r.command,
            "force": r.force,
        }
        if axis.current:
            seen["force_measured"] = r.force_measured
        if axis.marks:
            seen["index"] = r.index
        np.savez(folder / f"run{i}.npz", **seen)
    (folder / "columns.toml").write_text(COLUMNS + axis.current * CURRENT + axis.marks * MARKS)
    lines: list[str] = []
    for name, values in axis.public().items():
        lines.append(f"[{name}]")
        lines += [f"{k} = {json.dumps(v)}" for k, v in values.items()]
    (folder / "nominal.toml").write_text("\n".join(lines) + "\n")


def selftest(
    count: int, seed: int, out: Path | None = None, jobs: int = 0, replicates: int = 0, near: bool = False
) -> int:
    """Run the blind test and print the table.

    Args:
        out: keep the axes and the answers here.
        jobs: solvers at a time; 0 takes one for each core.
        replicates: solve every axis so many times more with its blocks of time drawn anew.
        near: as of ``generate``.

    Returns:
        0 when at least nine tenths of the axes were judged right, else 1.
    """
    print(f"drawing {count} axes", file=sys.stderr, flush=True)
    axes = generate(count, seed, near)

    def judge(axis: Axis, folder: Path) -> Scored:
        records = record(axis, heldout=True)
        write_public(axis, records[:4], folder)
        return _judge(axis, records, folder, replicates)

    return judge_all(axes, judge, out, jobs)


def _judge(axis: Axis, records: list[Recording], folder: Path, replicates: int) -> Scored:
    options = ["--jobs", "1"]
    for name in set(axis.nameless) & set(NAMED):
        options += ["--without", name]
    answer = solve(folder, "axis", *options)
    again = [solve(folder, "axis", *options, "--resample", str(i), report=f"again{i}") for i in range(replicates)]
    share = closed(folder, records) if (folder / "report" / "model.toml").exists() else None
    return score(axis, answer, share, again)
