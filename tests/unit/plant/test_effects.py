"""Effects file: what is taken, and one sentence for each mistake."""

import math

import numpy as np
import pytest

from sioms.plant.effects import CATALOGUE, EffectsError, Place, build_effects, parse_effects
from sioms.plant.forces import DRAGS, DRY, FORCES
from sioms.plant.motor import MotorBank
from sioms.plant.parameters import Motor

EXAMPLE = """
[xaxis]
coulomb = { level = 2.5, level_minus = 3.1 }
cogging = [ { amplitude = 0.8, pitch = 0.032 }, { amplitude = 0.1, pitch = 0.016, phase = 1.0 } ]

["*"]
delay = { delay_s = 0.002 }
coulomb = { level = 1.0 }
"""


def test_example_by_axis():
    effects = parse_effects(EXAMPLE, ["xaxis", "yaxis"])
    assert [e.name for e in effects] == ["coulomb", "delay", "cogging", "cogging"]
    coulomb, delay, first, second = effects
    np.testing.assert_array_equal(coulomb.values["level"], [2.5, 1.0])
    np.testing.assert_array_equal(coulomb.values["level_minus"], [3.1, 1.0])
    np.testing.assert_array_equal(delay.active, [True, True])
    np.testing.assert_array_equal(first.values["amplitude"], [0.8, 0.0])
    np.testing.assert_array_equal(second.values["phase"], [1.0, 0.0])


def test_all_mistakes_at_once_with_a_hint():
    text = """
    [xaxes]
    coulomb = { level = 1 }
    [xaxis]
    coloumb = { level = 1 }
    backlash = { gap = -1.0, load_fraction = 0.5 }
    delay = { delay = 0.1 }
    viscous = 3
    """
    with pytest.raises(EffectsError) as caught:
        parse_effects(text, ["xaxis"], "hidden.toml")
    lines = str(caught.value).splitlines()
    assert len(lines) == 6 and all("hidden.toml" in line for line in lines)
    for words in (
        "'xaxes': no such axis; did you mean 'xaxis'",
        "'coloumb': no such effect; did you mean 'coulomb'",
        "gap = -1 position; must be 0 to inf",
        "no parameter 'delay'; did you mean 'delay_s'",
        "delay_s [s] missing",
        "3 is not a table",
    ):
        assert any(words in line for line in lines), words


@pytest.mark.parametrize("value", [math.nan, math.inf, True, "1"])
def test_numbers_must_be_finite_numbers(value):
    with pytest.raises(EffectsError, match="not a finite number"):
        build_effects({"x": {"payload": {"mass": value}}}, ["x"])


def test_not_toml():
    with pytest.raises(EffectsError, match="want a TOML table"):
        parse_effects("[x", ["x"])


def test_every_catalogued_force_exists():
    for name, kind in CATALOGUE.items():
        assert (name in FORCES) == (kind.place in (Place.MOTOR, Place.LOAD))
        assert ((name in DRY) != (name in DRAGS)) == (kind.place is Place.RESISTANCE)


def _numbers(name):
    """Some number for every parameter of an effect, chosen to matter."""
    special = {"pitch": 0.01, "tau_s": 0.01, "delay_s": 0.0025, "frequency_hz": 30.0, "gap": 1e-3, "gain": 1.1,
               "factor": 50.0, "limit": 1.0, "rated_force": 1.0, "velocity": 0.05, "stiffness": 200.0, "rest": 0.02,
               "amplitude": 0.4, "load_fraction": 0.5, "limit_minus": 1.0}  # fmt: skip
    return {key: special.get(key, 0.3) for key in CATALOGUE[name].parameters}


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_effect_changes_its_axis_and_no_other(name):
    """Axis 0 has the effect, axis 1 does not: 1 moves as in a bank without effects, 0 does not."""
    motors = [Motor(mass=1.0, viscous=1.0, coulomb=0.1, encoder_step=1e-5, start=0.003)] * 2
    plain, changed = (
        MotorBank(motors, 1e-3, build_effects(table, ["a", "b"])) for table in ({}, {"a": {name: _numbers(name)}})
    )
    for tick in range(400):
        force = np.full(2, 2.0 * math.sin(tick / 40))
        plain.advance(force)
        changed.advance(force)
    assert changed.position[1] == pytest.approx(plain.position[1], rel=1e-6, abs=1e-9)
    assert changed.encoder.position[1] == pytest.approx(plain.encoder.position[1], abs=1.1e-5)
    assert abs(changed.encoder.position[0] - plain.encoder.position[0]) > 2e-5
    assert np.isfinite(changed.position).all()


def test_two_transmissions_are_refused():
    table = {
        "a": {
            "elastic": {"frequency_hz": 30, "load_fraction": 0.5},
            "backlash": {"gap": 1e-3, "load_fraction": 0.5},
        }
    }
    with pytest.raises(EffectsError, match="one at most"):
        MotorBank([Motor(mass=1.0)], 1e-3, build_effects(table, ["a"]))
