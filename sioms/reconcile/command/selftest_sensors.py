"""``sioms reconcile selftest tactile|force``: generate sensors with hidden effects, solve them blind, print the
figures.

The generator and the truth live in this process; every sensor is solved by a process of its own that is given a
folder with recordings, column description and nominal model.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sioms.reconcile.command.blind import MIXTURE, in_turn, judge_all, solve
from sioms.reconcile_selftest import finger_draw, force_world
from sioms.reconcile_selftest.finger_draw import HiddenFinger, draw_finger
from sioms.reconcile_selftest.finger_world import FingerWorld
from sioms.reconcile_selftest.force_world import COMPONENTS, HiddenSensor, draw_sensor, record
from sioms.reconcile_selftest.score import Scored
from sioms.reconcile_selftest.sensors import score_sensor

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


def generate(subject: str, count: int, seed: int, kinds: Sequence[str] = MIXTURE) -> list[HiddenFinger | HiddenSensor]:
    """Draw the sensors of a test; every effect comes up in turn."""
    rng = np.random.default_rng(seed)
    source = finger_draw if subject == "tactile" else force_world
    effects = {"single": source.NAMED, "unknown": source.NAMELESS}
    if subject == "force":
        effects["confounded"] = tuple(force_world.CONFOUNDED)
    draw: Any = draw_finger if subject == "tactile" else draw_sensor
    return [draw(f"{subject}{i:03d}", kind, rng, only) for i, kind, only in in_turn(count, rng, effects, kinds)]


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
    return judge_all(drawn, lambda hidden, folder: judge(subject, hidden, folder, seed), out, jobs)
