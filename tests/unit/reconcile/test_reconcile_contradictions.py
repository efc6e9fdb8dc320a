"""Records that contradict themselves are refused before anything is searched, with what would be right."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sioms.reconcile.axis import analyse
from sioms.reconcile.command import main
from sioms.reconcile.command.damaged import COLUMNS, damaged, write
from sioms.reconcile.contradictions import LEFT_OUT, check_law, usable
from sioms.reconcile.controlled import beyond_feedback
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.axis import read_data, read_model
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.prepare import Options, prepare
from sioms.reconcile.records import Record, Session
from sioms.reconcile.verdict import Outcome
from sioms.reconcile_selftest.damage import Public
from sioms.reconcile_selftest.damage_within import EVERY

AXES = Path(__file__).parents[2] / "physics" / "reconcile_axes"
Change = Callable[[Record], Record]


@cache
def given() -> tuple[Session, AxisModel]:
    """Return an axis that hides nothing, without the time of its rows."""
    model = read_model(AXES / "s05" / "nominal.json")
    session = read_data(AXES / "s05", model)
    return replace(session, records=tuple(replace(r, time_s=None) for r in session.records)), model


def every(change: Change) -> Session:
    """Change every record."""
    session, _ = given()
    return replace(session, records=tuple(change(r) for r in session.records))


def rows(chosen: Callable[[int], np.ndarray]) -> Change:
    """Take other rows."""
    return lambda r: Record(r.name, **{name: a[chosen(len(r))] for name, a in r.arrays().items()})


def both(session: Session, model: AxisModel) -> tuple[Session, list[str]]:
    """Look at all of the records."""
    return usable(session, session, model)


def noise(r: Record) -> Record:
    rng = np.random.default_rng(len(r.name))
    return replace(r, **{n: np.std(a) * rng.standard_normal(len(r)) for n, a in r.arrays().items() if n != "index"})


def late(a: np.ndarray | None, n: int) -> np.ndarray:
    """Take every value some rows late; the first stands meanwhile."""
    assert a is not None
    return np.concatenate([np.full(n, a[0]), a[:-n]])


def exchanged(rows: np.ndarray, first: int) -> np.ndarray:
    """Exchange every two neighbours, beginning with a row."""
    n = (len(rows) - first) // 2 * 2
    pairs = rows[first : first + n].reshape(-1, 2)[:, ::-1].ravel()
    return np.concatenate([rows[:first], pairs, rows[first + n :]])


def test_records_that_agree_with_themselves_pass() -> None:
    prepare(*given(), Options(pictures=False))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (rows(lambda n: np.repeat(np.arange(n), 2)), "come twice"),
        (rows(lambda n: np.random.default_rng(1).permutation(n)), "no order of time"),
        (noise, "it is noise"),
        (lambda r: replace(r, position=r.command, command=r.position), "exchanged"),
        (lambda r: replace(r, force=np.roll(r.force, 7)), "7 rows"),
        (lambda r: replace(r, force=np.roll(r.force, 8)), "8 rows"),
        (lambda r: replace(r, command=late(r.command, 30)), "the command is taken 30 rows later"),
        (lambda r: replace(r, position=late(r.position, 20)), "the position is taken 20 rows later"),
        (lambda r: replace(r, position=np.repeat(r.position[::4], 4)[: len(r)]), "every row of 4 only"),
        (rows(lambda n: exchanged(np.arange(n), 0)), "exchanged; the rows are in no order of time"),
        (lambda r: replace(r, command=exchanged(np.asarray(r.command), 0)), "the command is smoother with"),
        (rows(lambda n: exchanged(np.arange(n), 1)), "exchanged; the rows are in no order of time"),
        (lambda r: replace(r, command=-r.command), "turned round"),
        (rows(lambda n: np.arange(n)[::-1]), "reverse order"),
        (lambda r: replace(r, position=r.position % (0.3 * np.ptp(r.position))), "leaps"),
    ],
)
def test_a_contradiction_is_refused_with_its_reason(change: Change, said: str) -> None:
    with pytest.raises(BadInputError, match=said):
        both(every(change), given()[1])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (rows(lambda n: np.arange(0, n, 2)), "0.2[45]"),
        (lambda r: replace(r, force=1e3 * r.force), "another unit"),
        (lambda r: replace(r, force=np.roll(r.force, len(r) // 2)), "not of the same run|of another axis|turned round"),
    ],
)
def test_without_a_controller_the_motion_is_the_witness(change: Change, said: str) -> None:
    model = replace(given()[1], controller=None)
    session = every(lambda r: change(replace(r, command=None, force_measured=None)))
    with pytest.raises(BadInputError, match=said):
        prepare(session, model, Options(pictures=False))


def test_a_controller_that_has_nothing_to_do_with_the_force_is_of_another_axis() -> None:
    session, model = given()
    assert model.controller is not None
    check_law(session, model)
    other = replace(model, controller=replace(model.controller, k=4.0 * model.controller.k))
    with pytest.raises(BadInputError, match="leave out"):
        check_law(session, other)


def test_interpolated_rows_are_not_what_the_controller_made() -> None:
    """A busy machine loses ticks, a fifth of them here; with 0.8 N for a count what fills them in obeys no law."""
    gains = Controller(825e3, -0.914, 0.0, 0.0, 0.0, 60.0, 0.0)
    model = replace(given()[1], resolution=1e-6, controller=gains)
    t = np.arange(5000) * model.sample_time_s
    position = 1e-6 * np.rint(1e4 * np.sin(3.0 * t))
    command = 0.01 * np.sin(3.0 * t + 1e-4)
    e = command - position
    force = gains.k * (e + gains.kz * np.concatenate([e[:1], e[:-1]]))
    whole = Record("whole", position, force, command=command)
    kept = np.random.default_rng(4).random(len(t)) > 0.2
    filled = replace(whole, filled=~kept, **{n: np.interp(t, t[kept], a[kept]) for n, a in whole.arrays().items()})
    assert beyond_feedback(whole, model) < 1e-6
    assert beyond_feedback(filled, model) < 0.01
    assert beyond_feedback(replace(filled, force=-filled.force), model) > 1.0, "what was recorded counts"


def test_where_the_controller_makes_another_force_something_is_missing() -> None:
    _, model = given()
    assert model.controller is not None
    size = 0.1 / model.controller.k

    def spiked(r: Record) -> Record:
        """Put a spike of a tenth of the force into every fiftieth row of the command."""
        assert r.command is not None
        spikes = size * float(np.quantile(np.abs(r.force), 0.98)) * (np.arange(len(r)) % 50 == 0)
        return replace(r, command=r.command + spikes)

    found = analyse(every(spiked), model, Options(pictures=False))
    assert found.outcome is Outcome.UNEXPLAINED and not found.effects
    assert any("does not make the recorded force" in note for note in found.notes)


def test_one_record_of_another_rate_is_found_among_the_others() -> None:
    session, model = given()
    bare = tuple(replace(r, command=None, force_measured=None) for r in session.records)
    odd = rows(lambda n: np.arange(0, n, 2))(bare[0])
    with pytest.raises(BadInputError, match="compare records"):
        prepare(replace(session, records=(odd, *bare[1:])), replace(model, controller=None), Options(pictures=False))


def test_one_bad_record_is_left_out_and_two_of_three_are_too_many() -> None:
    session, model = given()
    doubled = rows(lambda n: np.repeat(np.arange(n), 2))
    good, bad = session.records[0], doubled(session.records[1].cut(0, len(session.records[0]) // 4))
    kept, notes = both(replace(session, records=(good, bad)), model)
    assert [r.name for r in kept.records] == [good.name] and not kept.continuous
    assert "left out" in notes[0] and bad.name in notes[0] and "come twice" in notes[0]
    with pytest.raises(BadInputError, match="come twice"):
        both(replace(session, records=(good, doubled(good), doubled(good))), model)
    with pytest.raises(BadInputError, match="come twice"):  # a final record was chosen to be one
        both(replace(session, final=(bad,)), model)


def test_one_record_of_which_another_loop_makes_the_force_is_left_out() -> None:
    """A third of the force is too little to say that the controller is another axis's; it is none of this one's."""
    session, model = given()
    one, two, *rest = session.records
    two = replace(two, force_measured=None)
    foreign = replace(two, force=np.where(np.arange(len(two)) < len(two) // 2, two.force, 0.7 * two.force))
    assert 0.05 < beyond_feedback(foreign, model) < 0.5
    kept, (note,) = both(replace(session, records=(one, foreign, *rest)), model)
    assert foreign.name not in [r.name for r in kept.records]
    assert foreign.name in note and "as it does in" in note
    peak = 0.5 * float(np.max(np.abs(two.force)))
    limited = replace(two, force=np.clip(two.force, -peak, peak))
    assert beyond_feedback(limited, model) > 0.05
    assert not both(replace(session, records=(one, limited, *rest)), model)[1], "a lower limit is an effect"


def test_a_force_that_takes_two_levels_is_no_saturation() -> None:
    _, model = given()
    open_loop = every(lambda r: replace(r, force=np.where(np.arange(len(r)) % 900 < 600, 1.0, 0.4), command=None))
    both(open_loop, replace(model, controller=None))


def test_an_inertia_that_is_said_to_be_uncertain_may_be_any() -> None:
    session, model = given()
    wrong = replace(model, inertia=50.0 * model.inertia, controller=None)
    with pytest.raises(BadInputError, match="refine"):
        prepare(session, wrong, Options(pictures=False))
    prepare(session, replace(wrong, refine=("inertia",)), Options(pictures=False))


def public() -> Public:
    """Lay the axis out as the self-test does."""
    session, model = given()
    n = 1200
    runs = tuple(
        {
            "time": np.arange(n) * model.sample_time_s,
            "counts": np.rint(r.position[:n] / model.resolution).astype(np.int64),
            "command": r.command[:n],  # type: ignore[index]
            "force": r.force[:n],
            "force_measured": r.force_measured[:n],  # type: ignore[index]
        }
        for r in session.records[:2]
    )
    axis = {
        "kind": "linear",
        **{k: getattr(model, k) for k in ("sample_time_s", "inertia", "viscous", "resolution", "pitch")},
        **{k: getattr(model, k) for k in ("rated_force", "max_speed")},
    }
    assert model.controller is not None
    keys = ("k", "kz", "kp", "kb", "offset", "limit", "velocity_filter_hz", "velocity_mean")
    return Public(runs, tuple(COLUMNS), {"axis": axis, "controller": {k: getattr(model.controller, k) for k in keys}})


@pytest.mark.parametrize("kind", EVERY)
def test_every_kind_of_damage_makes_something_else(kind: str, tmp_path: Path) -> None:
    """A kind that leaves everything as it was would be right by being wrong."""
    one, other = public(), public()
    other = other.each(lambda r: {k: a[::-1] for k, a in r.items()})
    other = replace(other, model={k: dict.fromkeys(v, 2) for k, v in other.model.items()})
    changed = EVERY[kind](one, other, np.random.default_rng(1))
    for name, p in (("one", one), ("changed", changed)):
        write(p, tmp_path / name)
    files = [{f.name: f.read_bytes() for f in (tmp_path / n).iterdir()} for n in ("one", "changed")]
    assert files[0] != files[1]


def test_damage_to_files_and_models_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    kinds = ("NPZ of garbage", "MAT of version 7.3", "model of garbage", "time in minutes", "pitch no number")
    assert damaged(3, main, kinds, pool=[(public(), public())]) == 0
    shown = capsys.readouterr().out
    assert shown.count("right  ") == len(kinds) and "traceback" in shown


def test_a_damaged_record_that_is_left_out_is_right_where_the_rest_tells_what_it_hides(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def answers(verdict: str, names: list[str], note: str) -> Callable[[list[str]], int]:
        def solve(arguments: list[str]) -> int:
            out = Path(arguments[arguments.index("--out") + 1])
            out.mkdir()
            found = {"verdict": verdict, "effects": names, "alternatives": [], "notes": [note]}
            (out / "verdict.json").write_text(json.dumps(found))
            return 0

        return solve

    pool = [(replace(public(), hidden=("backlash",)), public())]
    told = f"{LEFT_OUT}: read record run0: the rows are taken in reverse order"
    for verdict, names, note, status in (
        ("named", ["backlash"], told, 0), ("named", ["coulomb"], told, 1), ("none", [], told, 1),
        ("named", ["backlash"], "", 1),
    ):  # fmt: skip
        assert damaged(3, answers(verdict, names, note), ("one record backwards",), pool=pool) == status
    capsys.readouterr()
