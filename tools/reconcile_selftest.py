"""``sioms reconcile selftest``: generate axes with hidden effects, solve them blind, print the figures.

The generator and the truth live in this process; every axis is solved by a process of its own that is given a
folder with the public part only.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from sioms.reconcile_selftest.draw import CONFOUNDED, NAMED, NAMELESS, SAMPLE_S, Axis, commands, draw_axis
from sioms.reconcile_selftest.score import Scored, score, table
from sioms.reconcile_selftest.world import Recording, World

#: The mixture of kinds, repeated: out of twenty axes.
MIXTURE = ("null", "single", "multi", "unknown", "single", "confounded", "multi", "single", "null", "multi",
           "single", "unknown", "null", "single", "confounded", "multi", "single", "unknown", "multi", "single")
RECORD_S = 5.0
COLUMNS = """[columns]
time = { name = "time", unit = "s" }
position = { name = "counts", unit = "count" }
command = { name = "command" }
force = { name = "force" }
force_measured = { name = "force_measured" }
index = { name = "index" }
"""


def generate(count: int, seed: int) -> list[Axis]:
    """Draw the axes of a test; every effect comes up in turn."""
    rng = np.random.default_rng(seed)
    turns = {"single": list(rng.permutation(NAMED)), "unknown": list(rng.permutation(NAMELESS)),
             "confounded": list(rng.permutation(list(CONFOUNDED)))}
    out = []
    for i in range(count):
        kind = MIXTURE[i % len(MIXTURE)]
        only = ""
        if kind in turns:
            only = str(turns[kind][0])
            turns[kind] = turns[kind][1:] + turns[kind][:1]
        out.append(draw_axis(f"axis{i:03d}", kind, rng, only))
    return out


def record_all(axes: list[Axis], seed: int, seconds: float = RECORD_S) -> list[list[Recording]]:
    """Record all axes; per axis its four recordings."""
    rng = np.random.default_rng([seed, 1])
    world = World(axes, rng, np.zeros(len(axes)))
    orders = [commands(a, seconds, rng) for a in axes]
    runs = [world.record([o[r] for o in orders]) for r in range(4)]
    return [[run[j] for run in runs] for j in range(len(axes))]


def write_public(axis: Axis, recordings: list[Recording], folder: Path) -> None:
    """Write what the solver may see: records, column description and nominal model."""
    folder.mkdir(parents=True)
    for i, r in enumerate(recordings):
        np.savez(folder / f"run{i}.npz", time=np.arange(len(r.counts)) * SAMPLE_S, counts=r.counts, command=r.command,
                 force=r.force, force_measured=r.force_measured, index=r.index)
    (folder / "columns.toml").write_text(COLUMNS)
    lines: list[str] = []
    for name, values in axis.public().items():
        lines.append(f"[{name}]")
        lines += [f"{k} = {json.dumps(v)}" for k, v in dict(values).items()]  # type: ignore[call-overload]
    (folder / "nominal.toml").write_text("\n".join(lines) + "\n")


def solve(folder: Path) -> dict[str, Any]:
    """Solve one axis in a process of its own; return its verdict."""
    out = folder / "report"
    done = subprocess.run([sys.executable, "-m", "sioms.tools.reconcile", "axis", str(folder), "--model",
                           str(folder / "nominal.toml"), "--columns", str(folder / "columns.toml"), "--out", str(out), "--quiet"],
                          capture_output=True, text=True, check=False)
    answer = out / "verdict.json"
    if not answer.exists():
        return {"verdict": f"error: exit {done.returncode}: {done.stderr.strip()[-300:]}", "effects": [], "alternatives": [],
                "separating_experiment": "", "details": [], "gaps": [], "seconds": 0.0}
    found: dict[str, Any] = json.loads(answer.read_text())
    return found


def selftest(count: int, seed: int, out: Path | None = None, jobs: int = 0) -> int:
    """Run the blind test and print the table.

    Args:
        out: keep the axes and the answers here.
        jobs: solvers at a time; 0 takes one for each core.

    Returns:
        0 when at least nine tenths of the axes were judged right, else 1.
    """
    axes = generate(count, seed)
    print(f"generating {count} axes", file=sys.stderr, flush=True)
    recordings = record_all(axes, seed)
    rows: list[Scored] = []
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(jobs or os.cpu_count() or 1) as pool:
        base = out if out is not None else Path(temporary)
        for axis, records in zip(axes, recordings, strict=True):
            write_public(axis, records, base / axis.name)
        for axis, answer in zip(axes, pool.map(solve, [base / a.name for a in axes]), strict=True):
            row = score(axis, answer)
            rows.append(row)
            hidden = ", ".join((*axis.named, *axis.nameless)) or "nothing"
            print(f"{axis.name} {axis.kind:10s} {'right' if row.right else 'WRONG'}  hidden {hidden} | {row.verdict}: "
                  f"{', '.join(row.got) or '-'} ({row.seconds:.0f} s)", flush=True)
    print(table(rows))
    return 0 if sum(r.right for r in rows) >= 0.9 * len(rows) else 1
