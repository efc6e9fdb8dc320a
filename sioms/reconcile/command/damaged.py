"""``sioms reconcile selftest --damaged``: damage what generated axes recorded, and see that nothing is named.

An answer is an *error* that says what is wrong, or a *refusal* (unexplained). A name, "nothing is missing", and a
traceback are faults; unless what is damaged was left out with its reason, and the rest tells what it hides.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sioms.reconcile.command.selftest import record
from sioms.reconcile.contradictions import LEFT_OUT
from sioms.reconcile_selftest.axis import Axis
from sioms.reconcile_selftest.damage import Public
from sioms.reconcile_selftest.damage_within import EVERY
from sioms.reconcile_selftest.draw import draw_axis

#: Axes that are damaged in turn, each with another one of its kind; and what they hide.
POOL, HIDDEN = 4, ("null", "single")
COLUMNS = {
    "time": '{ name = "time", unit = "s" }',
    "position": '{ name = "counts", unit = "count" }',
    "command": '{ name = "command" }',
    "force": '{ name = "force" }',
    "force_measured": '{ name = "force_measured" }',
}
TRACEBACK, ERROR = "traceback", "error"


@dataclass(frozen=True, slots=True)
class Answer:
    """What was said to one kind of damage.

    Attributes:
        outcome: "error", "traceback", or the verdict.
        names: that it gave, also beside a refusal.
        left_out: whether records were, and the names are all that the others hide, or among what they may hide.
    """

    kind: str
    outcome: str
    names: tuple[str, ...]
    text: str
    seconds: float
    left_out: bool = False

    @property
    def right(self) -> bool:
        """Whether nothing was named that is not there."""
        return self.outcome == ERROR or (self.outcome == "unexplained" and not self.names) or self.left_out


def damaged(
    seed: int,
    solve: Callable[[list[str]], int],
    only: Sequence[str] = (),
    pool: Sequence[tuple[Public, Public]] = (),
) -> int:
    """Go through all kinds of damage; print a line each, and the sums.

    Args:
        solve: runs ``sioms reconcile`` with arguments, and returns its exit status.
        only: kinds to try; all by default.
        pool: axes to damage, each with another one; by default they are drawn.

    Returns:
        0 when nothing was named, else 1.
    """
    rng = np.random.default_rng(seed)
    pairs = pool or [(_public(f"axis{i}", i, rng), _public(f"other{i}", i, rng)) for i in range(POOL)]
    answers: list[Answer] = []
    read = 0
    with tempfile.TemporaryDirectory() as base:
        for i, (kind, damage) in enumerate(EVERY.items()):
            if only and kind not in only:
                continue
            one, other = pairs[i % len(pairs)]
            folder = Path(base) / f"kind{i:03d}"
            write(damage(one, other, rng), folder)
            answers.append(_answer(kind, folder, solve, one.hidden))
            shutil.rmtree(folder)
            a = answers[-1]
            said = f"{a.outcome}{': ' + ', '.join(a.names) if a.names else ''}"
            print(f"{'right' if a.right else 'WRONG'}  {kind}: {said} | {a.text[:160]} ({a.seconds:.0f} s)", flush=True)
        for i, (one, _) in enumerate(pairs):
            write(one, Path(base) / f"whole{i}")
            read += _answer("undamaged", Path(base) / f"whole{i}", solve).outcome not in (ERROR, TRACEBACK)
    print(table(answers))
    print(f"{'undamaged: read and judged':50s} {read} of {len(pairs)}")
    return 0 if read == len(pairs) and all(a.right for a in answers) else 1


def _public(name: str, turn: int, rng: np.random.Generator) -> Public:
    """Draw and record an axis with a measured current, of the kind of machine whose turn it is."""
    while True:
        axis = draw_axis(name, HIDDEN[turn // 2 % len(HIDDEN)], rng)
        if axis.current and axis.rotary == (turn % 2 == 0):
            return _seen(axis)


def _seen(axis: Axis) -> Public:
    runs = tuple(
        {
            "time": np.arange(len(r.counts)) * axis.sample_s,
            "counts": r.counts,
            "command": r.command,
            "force": r.force,
            "force_measured": r.force_measured,
        }
        for r in record(axis)
    )
    return Public(runs, tuple(COLUMNS), axis.public(), hidden=(*axis.named, *axis.nameless))


def write(public: Public, folder: Path) -> None:
    """Write what the solver is given."""
    folder.mkdir(parents=True)
    for i, run in enumerate(public.runs):
        np.savez(folder / f"run{i}.npz", **run)  # type: ignore[arg-type]
    lines = ["[columns]", *(f"{name} = {COLUMNS[name]}" for name in public.described)]
    (folder / "columns.toml").write_text("\n".join(lines) + "\n")
    lines = []
    for name, values in public.model.items():
        lines += [f"[{name}]", *(f"{k} = {_toml(v)}" for k, v in values.items())]
    (folder / "nominal.toml").write_text("\n".join(lines) + "\n")
    for name, content in (public.raw or {}).items():
        (folder / Path(name).with_suffix(".npz")).unlink(missing_ok=True)
        (folder / name).write_bytes(content)


def _toml(value: Any) -> str:
    return "nan" if isinstance(value, float) and np.isnan(value) else json.dumps(value)


def _answer(kind: str, folder: Path, solve: Callable[[list[str]], int], hidden: tuple[str, ...] = ()) -> Answer:
    out, said = folder / "report", io.StringIO()
    arguments = ["axis", str(folder), "--model", str(folder / "nominal.toml"), "--out", str(out), "--quiet"]
    began = time.monotonic()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            status = solve([*arguments, "--jobs", "1"])
    except Exception:  # whatever escapes is what is looked for
        last = traceback.format_exc().strip().splitlines()[-1]
        return Answer(kind, TRACEBACK, (), last, time.monotonic() - began)
    seconds = time.monotonic() - began
    if not (out / "verdict.json").exists():
        text = said.getvalue().strip().replace(str(folder), "")
        told = status == 2 and text.startswith("bad input: ")
        return Answer(kind, ERROR if told else TRACEBACK, (), text.removeprefix("bad input: "), seconds)
    found: Mapping[str, Any] = json.loads((out / "verdict.json").read_text())
    names = tuple(dict.fromkeys([*found["effects"], *(n for a in found["alternatives"] for n in a)]))
    notes, outcome = found["notes"], str(found["verdict"])
    told = set(hidden) <= set(names) if outcome == "ambiguous" else set(names) == set(hidden)
    whole = told and outcome != "unexplained"
    return Answer(kind, outcome, names, (notes or [""])[-1], seconds, whole and any(LEFT_OUT in n for n in notes))


def table(answers: Sequence[Answer]) -> str:
    """Lay the sums out."""
    refused = [a for a in answers if a.outcome == "unexplained"]
    lines = [
        ("kinds of damaged or foreign input", len(answers)),
        ("error with its reason", sum(a.outcome == ERROR for a in answers)),
        ("refused, nothing named", sum(not a.names for a in refused)),
        ("refused beside a name for a part", sum(bool(a.names) for a in refused)),
        ("damaged records left out, the rest told", sum(a.left_out for a in answers)),
        ("a name", sum(a.outcome in ("named", "ambiguous") and not a.left_out for a in answers)),
        ("nothing is missing", sum(a.outcome == "none" and not a.left_out for a in answers)),
        ("traceback", sum(a.outcome == TRACEBACK for a in answers)),
    ]
    return "\n".join(f"{a:50s} {b}" for a, b in lines)
