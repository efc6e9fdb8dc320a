"""``sioms reconcile selftest tactile|force``: generate sensors with hidden effects, solve them blind, print the figures.

The generator and the truth live in this process; every sensor is solved by a process of its own that is given a
folder with recordings, column description and nominal model.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from sioms.reconcile_selftest import finger_draw, force_world
from sioms.reconcile_selftest.finger_draw import HiddenFinger, draw_finger
from sioms.reconcile_selftest.finger_world import FingerWorld
from sioms.reconcile_selftest.force_world import COMPONENTS, HiddenSensor, draw_sensor, record
from sioms.reconcile_selftest.score import Scored, table
from sioms.reconcile_selftest.sensors import score_sensor
from sioms.tools.reconcile_selftest import MIXTURE

COLUMNS = (
    "\n".join(
        [
            "[columns]",
            'time = { name = "t", unit = "s" }',
            'temperature = { name = "temp", unit = "C" }',
            "[load]",
            *(f'{n} = {{ name = "load_{n}", unit = "{"N m" if n[0] == "t" else "N"}" }}' for n in COMPONENTS),
            "[reading]",
            *(f'{n} = {{ name = "{n}", unit = "{"N m" if n[0] == "t" else "N"}" }}' for n in COMPONENTS),
        ]
    )
    + "\n"
)


def generate(
    subject: str, count: int, seed: int, kinds: Sequence[str] = MIXTURE
) -> list[HiddenFinger | HiddenSensor]:
    """Draw the sensors of a test; every effect comes up in turn."""
    rng = np.random.default_rng(seed)
    source = finger_draw if subject == "tactile" else force_world
    turns = {"single": list(rng.permutation(source.NAMED)), "unknown": list(rng.permutation(source.NAMELESS))}
    if subject == "force":
        turns["confounded"] = list(rng.permutation(list(force_world.CONFOUNDED)))
    out: list[HiddenFinger | HiddenSensor] = []
    for i in range(count):
        kind, only = kinds[i % len(kinds)], ""
        if kind in turns:
            only = str(turns[kind][0])
            turns[kind] = turns[kind][1:] + turns[kind][:1]
        draw: Any = draw_finger if subject == "tactile" else draw_sensor
        out.append(draw(f"{subject}{i:03d}", kind, rng, only))
    return out


def write_public(hidden: HiddenFinger | HiddenSensor, folder: Path, seed: int) -> None:
    """Record one sensor and write what the solver may see."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng([seed, sum(map(ord, hidden.name)), 1])
    if isinstance(hidden, HiddenFinger):
        for name, arrays in FingerWorld(hidden, rng).session().items():
            np.savez(folder / f"{name}.npz", **arrays)  # type: ignore[arg-type]
    else:
        np.savez(folder / "loads.npz", **record(hidden, rng))  # type: ignore[arg-type]
        (folder / "columns.toml").write_text(COLUMNS)
    (folder / "nominal.toml").write_text(hidden.public())


def solve(folder: Path, subject: str) -> dict[str, Any]:
    """Solve one sensor in a process of its own, on one core; return its verdict."""
    out = folder / "report"
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "sioms.tools.reconcile",
            subject,
            str(folder),
            "--model",
            str(folder / "nominal.toml"),
            "--out",
            str(out),
            "--quiet",
        ],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )
    answer = out / "verdict.json"
    if not answer.exists():
        return {
            "verdict": f"error: exit {done.returncode}: {done.stderr.strip()[-300:]}",
            "effects": [],
            "alternatives": [],
            "separating_experiment": "",
            "details": [],
            "gaps": [],
            "seconds": 0.0,
        }
    found: dict[str, Any] = json.loads(answer.read_text())
    return found


def judge(subject: str, hidden: HiddenFinger | HiddenSensor, folder: Path, seed: int) -> Scored:
    """Record, solve and score one sensor."""
    write_public(hidden, folder, seed)
    return score_sensor(hidden, solve(folder, subject))


def selftest(subject: str, count: int, seed: int, out: Path | None = None, jobs: int = 0) -> int:
    """Run the blind test and print the table.

    Returns:
        0 when at least nine tenths of the sensors were judged right, else 1.
    """
    drawn = generate(subject, count, seed)
    print(f"generating {count} sensors", file=sys.stderr, flush=True)
    rows: list[Scored] = []
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(jobs or os.cpu_count() or 1) as pool:
        base = out if out is not None else Path(temporary)
        for row in pool.map(lambda h: judge(subject, h, base / h.name, seed), drawn):
            rows.append(row)
            hidden = ", ".join((*row.axis.named, *row.axis.nameless)) or "nothing"
            print(
                f"{row.axis.name} {row.axis.kind:10s} {'right' if row.right else 'WRONG'}  hidden {hidden} | {row.verdict}: "
                f"{', '.join(row.got) or '-'} ({row.seconds:.0f} s)",
                flush=True,
            )
    print(table(rows))
    return 0 if sum(r.right for r in rows) >= 0.9 * len(rows) else 1
