"""``sioms reconcile selftest tactile|force|hand``: generate sensors with hidden effects, solve them blind, print the
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
from sioms.reconcile_selftest import finger_draw, force_world, hand_world
from sioms.reconcile_selftest.finger_draw import HiddenFinger, draw_finger
from sioms.reconcile_selftest.finger_world import FingerWorld
from sioms.reconcile_selftest.force_world import COMPONENTS, HiddenSensor, draw_sensor, record
from sioms.reconcile_selftest.hand_world import HiddenHand, draw_hand
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


#: What is hidden, by kind of subject.
Hidden = HiddenFinger | HiddenSensor | HiddenHand


def generate(subject: str, count: int, seed: int, kinds: Sequence[str] = MIXTURE) -> list[Hidden]:
    """Draw the sensors of a test; every effect comes up in turn."""
    rng = np.random.default_rng(seed)
    source: Any = {"tactile": finger_draw, "force": force_world, "hand": hand_world}[subject]
    draw: Any = {"tactile": draw_finger, "force": draw_sensor, "hand": draw_hand}[subject]
    effects = {"single": source.NAMED, "unknown": source.NAMELESS}
    if subject != "tactile":
        effects["confounded"] = tuple(source.CONFOUNDED)
    return [draw(f"{subject}{i:03d}", kind, rng, only) for i, kind, only in in_turn(count, rng, effects, kinds)]


def write_public(hidden: Hidden, folder: Path, seed: int) -> None:
    """Record one sensor and write what the solver may see."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng([seed, sum(map(ord, hidden.name)), 1])
    if isinstance(hidden, HiddenFinger):
        for name, arrays in FingerWorld(hidden, rng).session().items():
            np.savez(folder / f"{name}.npz", **arrays)  # type: ignore[arg-type]
    elif isinstance(hidden, HiddenHand):
        np.savez(folder / "grasps.npz", **hand_world.record(hidden, rng))  # type: ignore[arg-type]
    else:
        np.savez(folder / "loads.npz", **record(hidden, rng))  # type: ignore[arg-type]
        (folder / "columns.toml").write_text(COLUMNS)
    (folder / "nominal.toml").write_text(hidden.public())


def judge(subject: str, hidden: Hidden, folder: Path, seed: int) -> Scored:
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
