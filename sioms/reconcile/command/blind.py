"""What the blind tests of axes and of sensors share: kinds in turn, a solver that sees the public part alone, the
table.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sioms.children import ends_with_us
from sioms.reconcile_selftest.score import Hidden, Scored, table

H = TypeVar("H", bound=Hidden)

#: The mixture of kinds, repeated: out of twenty.
MIXTURE = (
    "null", "single", "multi", "unknown", "single", "confounded", "multi", "single", "null", "multi",
    "single", "unknown", "null", "single", "confounded", "multi", "single", "unknown", "multi", "single",
)  # fmt: skip


def in_turn(
    count: int,
    rng: np.random.Generator,
    effects: Mapping[str, Iterable[str]],
    kinds: Sequence[str] = MIXTURE,
) -> Iterator[tuple[int, str, str]]:
    """Yield number, kind and the one effect that is to be drawn, "" for any; every effect of a kind
    comes up in turn.
    """
    turns = {kind: [str(name) for name in rng.permutation(list(names))] for kind, names in effects.items()}
    for i in range(count):
        kind, only = kinds[i % len(kinds)], ""
        if kind in turns:
            only, *rest = turns[kind]
            turns[kind] = [*rest, only]
        yield i, kind, only


def solve(folder: Path, subject: str, *options: str, report: str = "report") -> dict[str, Any]:
    """Solve what is in a folder in a process of its own, on one core; return its verdict.

    Args:
        options: further ones of ``sioms reconcile``.
        report: name of the folder in it for the answer.
    """
    out = folder / report
    command = [sys.executable, "-P", "-m", "sioms.reconcile", subject, str(folder)]
    command += ["--model", str(folder / "nominal.toml"), "--out", str(out), "--quiet", "--no-pictures", *options]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        preexec_fn=ends_with_us(),
    )
    answer = out / "verdict.json"
    if not answer.exists():
        said = f"error: exit {done.returncode}: {done.stderr.strip()[-300:]}"
        empty: dict[str, Any] = {"effects": [], "alternatives": [], "details": [], "gaps": []}
        return {"verdict": said, "separating_experiment": "", "seconds": 0.0, **empty}
    found: dict[str, Any] = json.loads(answer.read_text())
    return found


def judge_all(hidden: Sequence[H], judge: Callable[[H, Path], Scored], out: Path | None = None, jobs: int = 0) -> int:
    """Judge them all, several at a time, and print a line each and the table.

    Args:
        judge: solves and scores one in a folder for it.
        out: keep the folders here.
        jobs: solvers at a time; 0 takes one for each core.

    Returns:
        0 when at least nine tenths were judged right, else 1.
    """
    rows: list[Scored] = []
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(jobs or os.cpu_count() or 1) as pool:
        base = out if out is not None else Path(temporary)
        for row in pool.map(lambda h: judge(h, base / h.name), hidden):
            rows.append(row)
            truth = ", ".join((*row.axis.named, *row.axis.nameless)) or "nothing"
            print(
                f"{row.axis.name} {row.axis.kind:10s} {'right' if row.right else 'WRONG'}  hidden {truth} | "
                f"{row.verdict}: {', '.join(row.got) or '-'} ({row.seconds:.0f} s)",
                flush=True,
            )
    print(table(rows))
    return 0 if sum(r.right for r in rows) >= 0.9 * len(rows) else 1
