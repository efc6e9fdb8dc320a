"""A geared arm as a user would record it: its servo a cascade of its own, its force the current, its friction LuGre's
with damping.

The arm is made here, in plain steps of 62 us, by equations that share nothing with the solver.
"""

from __future__ import annotations

from math import copysign, exp, floor, pi, sin, sqrt
from pathlib import Path

import numpy as np
import pytest

from sioms.reconcile.axis import analyse
from sioms.reconcile.files.axis import read_data, read_model
from sioms.reconcile.prepare import Options
from sioms.reconcile.verdict import Outcome

TRUE = {"weight": 14.0, "fc": 6.0, "fs": 9.0, "vs": 0.12, "stiffness": 3e4, "viscous": 9.0, "inertia": 2.1}
MODEL = """[axis]
kind = "rotary"
sample_time_s = 0.002
inertia = 2.0
viscous = 9.5
pitch = 0.0628318530717958
rated_force = 60.0
max_speed = 2.5
refine = ["inertia", "viscous"]
"""
COLUMNS = '[columns]\ntime = { name = "t [s]" }\nposition = { name = "q [deg]" }\nforce = { name = "tau [Nm]" }\n'


def path(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Swings over nearly four radians, ever slower, and small ones that hardly slide."""
    turned = 2 * pi * 0.9 * (1.0 - np.exp(-t / 2.0))
    swing = 1.7 * np.sin(1.5 * turned + rng.uniform(0, 2 * pi)) + 0.25 * np.sin(4.0 * turned + rng.uniform(0, 2 * pi))
    return swing + 0.03 * np.sin(2 * pi * 2.3 * t)


def record(folder: Path, name: str, seconds: float, seed: int) -> None:
    """Let the arm follow a path, and write what its drive would log every 2 ms."""
    rng = np.random.default_rng(seed)
    count, fine = int(seconds / 0.002), 32
    want = path(np.arange(count + 1) * 0.002, rng)
    step, h = 2 * pi / 400_000, 0.002 / fine
    x, v, z, current, held, seen_v, force = want[0], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    last = x
    damping = 0.3 * sqrt(TRUE["stiffness"] * TRUE["inertia"])
    rows = np.empty((count, 3))
    for k in range(count):
        rows[k, 0], rows[k, 1] = 0.002 * k, np.degrees(floor(x / step + 0.5) * step)
        total = 0.0
        for s in range(fine):
            if s % 2 == 0:  # the servo, at 8 kHz
                seen = floor(x / step + 0.5) * step
                seen_v += (1 - exp(-2 * h / 1e-3)) * ((seen - last) / (2 * h) - seen_v)
                last = seen
                aim = want[k] + (want[k + 1] - want[k]) * s / fine
                error = 15.0 * (aim - seen) + (want[k + 1] - want[k]) / 0.002 - seen_v
                held = min(max(held + 15.0 * error * 2 * h, -1.0), 1.0)
                current = min(max(90.0 * (error + held), -120.0), 120.0)
            force += (1 - exp(-h / 1e-3)) * (current - force)
            drawn = force + 0.05 * rng.standard_normal()
            total += drawn
            level = TRUE["fc"] + (TRUE["fs"] - TRUE["fc"]) * exp(-((v / TRUE["vs"]) ** 2))
            rate = v - TRUE["stiffness"] * abs(v) / level * z
            z = copysign(min(abs(z + rate * h), level / TRUE["stiffness"]), z + rate * h)
            friction = TRUE["stiffness"] * z + damping * rate * exp(-abs(v) / TRUE["vs"])
            v += (drawn - friction - TRUE["viscous"] * v - TRUE["weight"] * sin(x)) / TRUE["inertia"] * h
            x += v * h
        rows[k, 2] = total / fine
    (folder / f"{name}.csv").write_text(
        "t [s],q [deg],tau [Nm]\n" + "\n".join(f"{t:.3f},{q:.6f},{f:.5f}" for t, q, f in rows) + "\n"
    )


def test_a_geared_arm_gives_its_weight_and_both_sides_of_its_friction(tmp_path: Path) -> None:
    for k, seconds in enumerate((6.0, 5.0)):
        record(tmp_path, f"run{k}", seconds, k)
    (tmp_path / "columns.toml").write_text(COLUMNS)
    (tmp_path / "nominal.toml").write_text(MODEL)
    model = read_model(tmp_path / "nominal.toml")
    session = read_data(tmp_path, model)
    verdict = analyse(session, model, Options(pictures=False))
    assert set(verdict.model.effects) >= {"gravity", "lugre"}
    assert not {"stribeck", "coulomb", "presliding"} & set(verdict.model.effects)
    gravity, friction = verdict.model.effects["gravity"], verdict.model.effects["lugre"]
    assert gravity["amp"] == pytest.approx(TRUE["weight"], rel=0.02)
    assert abs(gravity["phase"]) == pytest.approx(pi, abs=0.02)
    assert friction["Fc"] == pytest.approx(TRUE["fc"], rel=0.05)
    # the damping of LuGre's bristles, which the library has not, goes into these
    assert friction["Fs"] == pytest.approx(TRUE["fs"], rel=0.2)
    assert friction["vs"] == pytest.approx(TRUE["vs"], rel=0.3)
    assert friction["xs"] == pytest.approx(TRUE["fs"] / TRUE["stiffness"], rel=0.6)
    assert verdict.outcome in (
        Outcome.NAMED,
        Outcome.AMBIGUOUS,
    )  # less than half a turn: a spring comes near gravity
    assert all(set(names) <= {"gravity", "lugre", "spring"} for names in verdict.alternatives)
    assert all(gap.after < 2.0 * gap.floor for gap in verdict.gaps if gap.known and "free" not in gap.channel)
