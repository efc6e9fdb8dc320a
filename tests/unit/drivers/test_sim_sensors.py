"""Simulated inputs, force sensor and finger, coupled to simulated axes through real pages."""

import msgspec
import numpy as np
import pytest

from sioms.drivers.sim.axes import SimAxes
from sioms.drivers.sim.force import SimForce
from sioms.drivers.sim.io import SimIo
from sioms.drivers.sim.tactile import SimTactile
from sioms.plant.finger import FingerShape, TactileArray
from sioms.protocol.flags import AnalogStatus, ControlMode

WALL = {"position": 0.01, "stiffness": 2e4, "damping": 100.0}
AXIS = {
    "name": "x", "velocity_max": 0.5, "acceleration_max": 5.0, "force_max": 60.0,
    "motor": {"mass": 2.0, "viscous": 60.0},
}  # fmt: skip
TWO = [AXIS, AXIS | {"name": "z", "motor": AXIS["motor"] | {"wall": WALL}}]


def test_beam_edges_carry_the_instant_of_the_crossing(bench):
    mod = bench.make(SimAxes, "mod0", {"axis": TWO})
    boxes = [{"mod0.plant.x_position": [0.05, 0.0505]}]
    beams = bench.make(SimIo, "beams", {"inputs": 2, "beam": [{"bit": 1, "boxes": boxes}]})
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode.VELOCITY, velocity=0.5)
    port = beams.blocks[0]
    log, seen = [], set()
    for _ in range(300):
        bench.run(0.001)
        log.append((bench.clock_ns, mod.blocks[1].data[0]))
        seen.add((int(port.data[0]), int(port.rows["changed_ns"][0])))
    assert port.data[0] == 0 and port.edges[0] == 2
    # Found by interpolating the record of the positions; the object is passed in 1 ms.
    stamps, positions = np.array(log).T
    leave = np.interp(0.0505, positions, stamps)
    enter = np.interp(0.05, positions, stamps)
    assert port.rows["changed_ns"][0] == pytest.approx(leave, abs=1000)
    seen.update(bench.published)
    assert any(data == 2 and abs(stamp - enter) < 1000 for data, stamp in seen)


def test_two_edges_in_one_tick_are_two_snapshots(bench):
    bench.make(SimIo, "io0", {"inputs": 1, "wave": [{"bit": 0, "period_s": 0.001, "high_s": 0.0002}]})
    bench.run(0.02)
    stamps = [stamp for _, stamp in bench.published]
    assert [data for data, _ in bench.published] == [1] * len(stamps)
    assert len(stamps) >= 18 and set(np.diff(stamps)) == {1_000_000}


def test_triggered_wave_counts_its_periods_and_ends_with_its_trigger(bench):
    wave = {"bit": 0, "period_s": 0.004, "high_s": 0.002, "count": 3, "trigger_bit": 0}
    io = bench.make(SimIo, "io0", {"outputs": 1, "inputs": 1, "wave": [wave]})
    bench.run(0.01)
    port = io.blocks[1]
    assert port.edges[0] == 0
    io.write_outputs(io.blocks[0].spec, [0], [1.0])
    bench.run(0.05)
    assert port.edges[0] == 6 and port.data[0] == 0
    io.write_outputs(io.blocks[0].spec, [0], [0.0])
    bench.run(0.01)
    io.write_outputs(io.blocks[0].spec, [0], [1.0])
    bench.run(0.003)
    assert port.data[0] == 1
    io.write_outputs(io.blocks[0].spec, [0], [0.0])
    bench.run(0.01)
    assert port.data[0] == 0 and port.edges[0] == 8


def test_gripper_and_loop(bench):
    gripper = {"bit": 2, "closed_bit": 0, "opened_bit": 1, "delay_s": 0.02, "travel_s": 0.1}
    io = bench.make(
        SimIo, "gripper0",
        {"outputs": 8, "inputs": 3, "gripper": [gripper], "loop": [{"bit": 2, "output_bit": 7}], "safe": 0},
    )  # fmt: skip
    outputs, inputs = io.blocks
    assert outputs.spec.name == "" and inputs.spec.name == "in" and outputs.spec.safe == (0.0,)
    bench.run(0.01)
    assert inputs.data[0] == 0b010
    io.write_outputs(outputs.spec, [0], [0b1000_0100])
    bench.run(0.001)
    began = bench.clock_ns
    assert outputs.data[0] == 0b1000_0100 and inputs.data[0] == 0b110
    bench.run(0.3, until=lambda: inputs.data[0] == 0b101)
    assert inputs.rows["changed_ns"][0] == began + 120_000_000


@pytest.mark.parametrize(
    "table, words",
    [
        ({}, "at least one bit"),
        (
            {"inputs": 1, "wave": [{"bit": 1, "period_s": 1, "high_s": 0.5}]},
            "input bit 1 is used but there are 1",
        ),
        ({"inputs": 1, "outputs": 1, "loop": [{"bit": 0, "output_bit": 0}] * 2}, "driven 2 times"),
        ({"outputs": 2, "safe": 4}, "safe = 4; want 0 to 3"),
        ({"inputs": 1, "wave": [{"bit": 0, "period_s": 1, "high_s": 1}]}, "want less"),
        ({"inputs": 1, "beam": [{"bit": 0, "boxes": [{"n": [2.0, 1.0]}]}]}, "want low first"),
    ],
)
def test_bad_wiring_is_told_by_describe(table, words):
    with pytest.raises(ValueError, match=words):
        SimIo.describe("io0", msgspec.convert(table, SimIo.Settings))


def test_force_sensor_feels_the_axis_and_says_when_it_cannot(bench):
    contact = {"node": "mod0.plant.z_contact", "direction": [0, 0, -1], "point_m": [0.0, 0.02, 0.1]}
    force = bench.make(SimForce, "force0", {"contact": [contact], "noise": [0.0] * 6})
    bench.run(0.01)
    assert np.all(force.blocks[0].flags == int(AnalogStatus.INVALID))
    mod = bench.make(SimAxes, "mod0", {"axis": TWO})
    bench.run(0.01)
    assert np.all(force.blocks[0].flags == 0)
    bench.write(mod, axis=1, control_mode=ControlMode.FORCE, force=12.0)
    bench.run(2.0)
    np.testing.assert_allclose(force.blocks[0].data, [0, 0, -12.0, -0.24, 0, 0], atol=0.011)


def test_finger_shows_the_pressed_object_where_it_is(bench):
    mod = bench.make(SimAxes, "mod0", {"axis": TWO})
    table = {
        "force_node": "mod0.plant.z_contact", "angle_node": "mod0.plant.x_position", "angle_per_position": 10.0,
        "angle_rad": 1.3, "noise": 0.0, "resolution": 0.0,
    }  # fmt: skip
    finger = bench.make(SimTactile, "tactile0", table)
    bench.run(0.02)
    np.testing.assert_array_equal(finger.blocks[0].data, np.zeros(16))
    bench.write(mod, axis=1, control_mode=ControlMode.FORCE, force=4.0)
    bench.write(mod, axis=0, control_mode=ControlMode.POSITION, position=0.03)
    bench.run(2.0)
    shape = FingerShape()
    expected = -100 * TactileArray(shape).strain(4.0 / shape.length_m, 1.6, 6e-3)
    np.testing.assert_allclose(finger.blocks[0].data, expected, atol=0.05)
    assert np.argmax(finger.blocks[0].data) == np.argmin(np.abs(np.array(shape.angles_rad) - 1.6))


MODEL = """[finger]
core_m = 0.0096
outer_m = 0.0127
shear_modulus_pa = 83000.0
poisson = 0.46
angle_rad = [1.6, 1.44, 1.28]
radius_m = 0.0103
gain = 3.0
[effects.gain_scatter]
g = [0.0, 0.0, {last}]
"""


def test_a_twin_takes_its_elements_and_effects_from_a_model_and_shows_which(bench, tmp_path):
    file = tmp_path / "model.toml"
    seen = []
    for last in (0.0, 0.25):
        file.write_text(MODEL.format(last=last))
        mod = bench.make(SimAxes, f"mod{len(seen)}", {"axis": TWO})
        force_node = f"mod{len(seen)}.plant.z_contact"
        table = {
            "model_file": str(file),
            "force_node": force_node,
            "angle_rad": 1.28,
            "noise": 0.0,
            "resolution": 0.0,
        }
        finger = bench.make(SimTactile, f"tactile{len(seen)}", table)
        bench.run(0.02)
        assert not finger.blocks[0].data.any()
        bench.write(mod, axis=1, control_mode=ControlMode.FORCE, force=4.0)
        bench.run(2.0)
        seen.append((finger.blocks[0].data.copy(), finger.blocks[0].spec.channels[0].description))
    (plain, first), (hidden, second) = seen
    assert plain[2] == plain.max() > 1.0
    np.testing.assert_allclose(hidden[:2], plain[:2], rtol=1e-3)
    assert hidden[2] == pytest.approx(plain[2] / 1.25, rel=1e-3)
    assert first != second and "model " in first


@pytest.mark.parametrize(
    "table, words",
    [
        ({"model_file": "/nowhere.toml"}, "No such file"),
        ({"gain": [1.0]}, "gain: 1 numbers; want 16"),
        ({"indenter_radius_m": -1.0}, "positive radius"),
    ],
)
def test_bad_finger_is_told_by_describe(table, words):
    with pytest.raises(ValueError, match=words):
        SimTactile.describe("tactile0", msgspec.convert(table, SimTactile.Settings))


def test_a_late_force_sensor_makes_up_for_its_samples_with_what_pressed_at_the_time(bench):
    """A press that came and went during a late tick is in the samples; those left out at rest are not made up for."""
    mod = bench.make(SimAxes, "mod0", {"axis": TWO})
    contact = {"node": "mod0.plant.z_contact", "direction": [0.0, 0.0, 1.0]}
    table = {"contact": [contact], "noise": [0.0] * 6, "history": 256}
    sensor = bench.make(SimForce, "force0", table)
    bench.run(0.05)
    (block,), plant = sensor.blocks, mod.blocks[1]

    def tick():
        sensor.tick(bench.clock_ns)
        bench._publish(block, bench.clock_ns)

    count = len(bench.shown(block))
    assert sensor.is_at_rest()
    bench.clock_ns += 40_000_000
    tick()
    assert len(bench.shown(block)) == count + 1, "left out"
    for at_ms in range(40):
        bench.clock_ns += 1_000_000
        plant.data[3] = 5.0 if 10 <= at_ms < 20 else 0.0
        bench._publish(plant, bench.clock_ns)
    tick()
    made_up = bench.shown(block)[count + 1 :]
    assert [bench.clock_ns - stamp for stamp, _ in made_up] == [late * 1_000_000 for late in range(39, -1, -1)]
    z = bench.forces(block)[-40:]
    assert [at for at, force in enumerate(z) if abs(force - 5.0) < 0.1] == [*range(10, 20)]
    bench.clock_ns += 200_000_000
    tick()
    overrun = [int(fields["flags"]) & AnalogStatus.OVERRUN != 0 for _, fields in bench.shown(block)[-129:]]
    assert overrun == [True] + 128 * [False], "what cannot be made up for is told"


@pytest.mark.parametrize(("to", "lost"), [(0.06, 2), (0.0, 0)])
def test_a_beam_that_missed_what_an_axis_did_counts_edges_as_lost_if_it_moved(bench, to, lost):
    mod = bench.make(SimAxes, "mod0", {"axis": [AXIS], "history": 16})
    boxes = [{"mod0.plant.x_position": [0.1, 0.2]}]
    beams = bench.make(SimIo, "beams", {"inputs": 1, "beam": [{"bit": 0, "boxes": boxes}]})
    bench.run(0.01)
    plant = mod.blocks[1]
    for at in np.linspace(0.0, to, 40):
        bench.clock_ns += 1_000_000
        plant.data[0] = at
        bench._publish(plant, bench.clock_ns)
    beams.tick(bench.clock_ns)
    assert beams.blocks[0].edges[0] == lost and beams.blocks[0].data[0] == 0
