"""Simulated axes: they move as commanded over their physics, home, stall, press and take hidden effects."""

import msgspec
import numpy as np
import pytest

from sioms.drivers.sim.axes import SimAxes
from sioms.drivers.sim.io import SimIo
from sioms.motion.queue import verdict
from sioms.protocol.flags import AxisStatus, ControlMode, NodeClass
from sioms.protocol.records import numpy_dtype

SERVO = {
    "name": "x", "velocity_max": 0.5, "acceleration_max": 5.0, "force_max": 60.0,
    "position_min": -0.2, "position_max": 0.5,
    "motor": {"mass": 2.0, "viscous": 4.0, "coulomb": 3.0, "stiction": 4.0, "encoder_step": 1e-6},
}  # fmt: skip
STEPPER = {
    "name": "belt", "velocity_max": 0.3, "acceleration_max": 2.0,
    "stepper": {"mass": 0.4, "step": 2e-4, "hold_force": 60.0, "coulomb": 3.0, "home": 0.0},
}  # fmt: skip


def status(driver, axis=0):
    return AxisStatus(int(driver.bank.rows["status"][axis]))


def test_servo_moves_to_its_goal_and_rests_within_friction(bench):
    mod = bench.make(SimAxes, "mod0", {"axis": [SERVO]})
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode.POSITION, position=0.2)
    bench.run(2.0, until=lambda: mod.bank.is_idle([0]))
    bench.run(0.3)
    stiffness = 2.0 * (2 * np.pi * 30) ** 2
    assert mod.bank.rows["position"][0] == pytest.approx(0.2, abs=3.0 / stiffness + 2e-6)
    true = mod.blocks[1].data[0]
    assert 0 <= true - mod.bank.rows["position"][0] < 1e-6 + 1e-9


def test_tracking_error_without_friction_is_that_of_the_acceleration(bench):
    axis = SERVO | {"motor": {"mass": 2.0}}
    mod = bench.make(SimAxes, "mod0", {"axis": [axis]})
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode.POSITION, position=0.2)
    worst = 0.0
    for _ in range(600):
        bench.run(0.001)
        worst = max(worst, abs(mod.bank.rows["following_error"][0]))
    # a/w^2 in steady acceleration; the step in acceleration of an unlimited jerk stays below twice that.
    assert 0.5 * 5.0 / (2 * np.pi * 30) ** 2 < worst < 2 * 5.0 / (2 * np.pi * 30) ** 2


def test_servo_and_stepper_in_one_device(bench):
    mod = bench.make(SimAxes, "mod0", {"axis": [STEPPER, SERVO]})
    bench.run(0.01)
    bench.write(mod, axis=0, control_mode=ControlMode.POSITION, position=0.05)
    bench.write(mod, axis=1, control_mode=ControlMode.POSITION, position=-0.1)
    bench.run(2.0, until=lambda: mod.bank.is_idle([0, 1]))
    bench.run(0.3)
    plant = mod.blocks[1].data
    assert plant[0] == pytest.approx(0.05, abs=2e-5)
    assert plant[2] == pytest.approx(-0.1, abs=2e-4)


def test_stepper_that_loses_steps_does_not_notice_but_the_world_does(bench):
    weak = STEPPER | {"acceleration_max": 300.0, "velocity_max": 1.5}
    mod = bench.make(SimAxes, "belt0", {"axis": [weak]})
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode.POSITION, position=0.3)
    bench.run(2.0, until=lambda: mod.bank.is_idle([0]))
    bench.run(0.3)
    assert mod.bank.rows["position"][0] == pytest.approx(0.3, abs=2e-5)
    assert mod.blocks[1].data[0] < 0.29


def test_stepper_with_an_encoder_finds_its_lost_steps_again(bench):
    """At full speed it falls out of step; the way that is left is too short to get so fast."""
    fast = STEPPER | {
        "acceleration_max": 8.0, "velocity_max": 1.5,
        "stepper": STEPPER["stepper"] | {"corner_velocity": 0.05, "load_force": -4.0, "encoder_step": 1e-6},
        "arrival": {"settle_s": 0.05, "tolerance": 1e-4, "retries": 10},
    }  # fmt: skip
    mod = bench.make(SimAxes, "belt0", {"axis": [fast]})
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode.POSITION, position=0.03)
    bench.run(3.0, until=lambda: mod.bank.is_idle([0]))
    tried = mod.bank.diagnostics([0])["retries"][0]
    assert 0 < tried < 10 and not status(mod) & AxisStatus.MISSED_TARGET
    assert mod.blocks[1].data[0] == pytest.approx(0.03, abs=1e-4 + 1e-6), "the load is there"
    assert mod.bank.rows["position"][0] == pytest.approx(0.03, abs=1e-4)


def test_stepper_that_slips_every_time_says_so(bench):
    stuck = STEPPER | {
        "stepper": STEPPER["stepper"] | {"hold_force": 3.2, "encoder_step": 1e-6},
        "arrival": {"tolerance": 1e-4, "retries": 3},
    }
    mod = bench.make(SimAxes, "belt0", {"axis": [stuck]})
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode.POSITION, position=0.05)
    bench.run(4.0, until=lambda: mod.bank.is_idle([0]))
    assert mod.bank.diagnostics([0])["retries"] == [3] and mod.bank.diagnostics([0])["misses"] == [1]
    assert status(mod) & AxisStatus.MISSED_TARGET
    assert (
        mod.blocks[1].data[0] == pytest.approx(mod.bank.rows["position"][0], abs=1e-5)
        and mod.bank.rows["position"][0] < 0.04
    )


def test_homing_finds_the_switch_edge(bench):
    homing = {"velocity": 0.1, "slow_velocity": 0.01, "direction": -1, "offset": 0.0}
    axis = SERVO | {
        "homing": homing,
        "position_min": -0.3,
        "motor": SERVO["motor"] | {"home": -0.05, "start": 0.02},
    }
    mod = bench.make(SimAxes, "mod0", {"axis": [axis]})
    bench.run(0.01)
    mod.bank.home([0], bench.clock_ns)
    bench.run(5.0, until=lambda: bool(status(mod) & AxisStatus.HOMED))
    bench.run(0.5)
    # The new coordinate counts from the edge of the switch.
    assert mod.bank.rows["position"][0] - (mod.blocks[1].data[0] + 0.05) == pytest.approx(0.0, abs=5e-5)


def test_force_mode_presses_on_the_wall(bench):
    wall = {"position": 0.01, "stiffness": 2e4, "damping": 100.0}
    axis = SERVO | {"motor": {"mass": 2.0, "viscous": 60.0, "wall": wall}}
    mod = bench.make(SimAxes, "mod0", {"axis": [axis]})
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode.FORCE, force=12.0)
    bench.run(2.0)
    assert mod.blocks[1].data[1] == pytest.approx(12.0, rel=1e-3)
    assert mod.blocks[1].data[0] == pytest.approx(0.01 + 12.0 / 2e4, rel=1e-3)


def test_late_ticks_cost_the_world_no_time(bench):
    """The plant falls freely for the whole time, also when ticks were skipped."""
    axis = SERVO | {"motor": {"mass": 1.0, "load_force": 1.0}, "k": 0.0}
    mod = bench.make(SimAxes, "mod0", {"axis": [axis]})
    mod.make_up_ns = 10**12
    bench.run(0.005)
    bench.clock_ns += 20_000_000
    bench.run(0.005)
    seconds = 0.005 + 0.020 + 0.005 - 0.001
    assert mod.blocks[1].data[0] == pytest.approx(1.0 * seconds**2 / 2, rel=1e-9)


def test_the_world_is_the_same_whether_it_goes_on_before_the_tick_or_in_the_slack_after_the_last(bench):
    mods = [bench.make(SimAxes, name, {"axis": [SERVO, STEPPER]}) for name in ("mod0", "mod1")]
    for mod in mods:
        mod.make_up_ns = 10**12
    told = [[], []]
    for at in (1, 2, 3, 4, 7, 8, 9, 300, 301, 302):  # some ticks late; the second device is given its slack
        bench.clock_ns = 1_000_000_000 + at * 1_000_000
        for mod, seen in zip(mods, told, strict=True):
            mod.tick(bench.clock_ns)
            seen.append(mod.bank.fields.copy())
        mods[1].slack(bench.clock_ns, bench.clock_ns)
        if at == 2:
            for mod in mods:
                bench.write(mod, control_mode=ControlMode.VELOCITY, velocity=0.1)
    assert np.array_equal(told[0], told[1])
    assert np.array_equal(mods[0].blocks[1].data, mods[1].blocks[1].data)


def test_a_count_makes_so_many_axes_with_all_their_channels():
    settings = msgspec.convert(
        {"axis": [SERVO | {"count": 3}], "beam": [{"boxes": [{"x2": [0, 1]}]}]}, SimAxes.Settings
    )
    axes, plant, beams = SimAxes.describe("mod0", settings).blocks
    assert [c.name for c in axes.channels] == ["x0", "x1", "x2"] and len(plant.channels) == 6
    assert beams.channels[0].width == 1


def test_own_beams_show_the_crossing_in_the_tick_in_which_it_happens(bench):
    mod = bench.make(
        SimAxes,
        "mod0",
        {"axis": [SERVO], "beam": [{"boxes": [{"x": [0.3, 1.0]}]}, {"boxes": [{"x": [0.05, 0.06]}]}]},
    )
    port = mod.blocks[2]
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode.POSITION, position=0.2)
    bench.run(1.0, until=lambda: port.data[0] == 0b10)
    assert 0 <= bench.clock_ns - port.rows["changed_ns"][0] < 1_000_000
    bench.run(1.0, until=lambda: port.data[0] == 0)
    # 10 mm at 0.5 m/s at most, in the acceleration of 5 m/s^2 from 0.05 m on.
    assert port.edges[0] == 2 and mod.blocks[1].data[0] > 0.06


def test_hidden_effects_file(bench, tmp_path):
    file = tmp_path / "hidden.toml"
    file.write_text('[x]\ncoulomb = { level = 9.0 }\n["*"]\noffset = { force = 5.0 }\n')
    hidden = bench.make(SimAxes, "mod0", {"axis": [SERVO | {"k": 0.0}], "effects_file": str(file)})
    plain = bench.make(SimAxes, "mod1", {"axis": [SERVO | {"k": 0.0}], "effects": {"x": {"offset": {"force": 5.0}}}})
    bench.run(0.2)
    # 5 N do not overcome 4 + 9 N of stiction, but 4 N alone.
    assert hidden.blocks[1].data[0] == 0.0
    assert plain.blocks[1].data[0] > 0.005


MODEL = """[axis]
name = "x"
kind = "linear"
sample_time_s = 0.001
inertia = 2.0
viscous = 4.0
resolution = 1e-6
pitch = 0.02
rated_force = 30.0
max_speed = 0.5
[effects.offset]
off = 5.0
[effects.coulomb]
on = {on}
Fc = 9.0
"""


def test_an_axis_with_a_model_file_is_the_twin_of_the_model(bench, tmp_path):
    moved, sums = [], []
    for name, on in (("mod0", "true"), ("mod1", "false")):
        file = tmp_path / f"{name}.toml"
        file.write_text(MODEL.replace("{on}", on))
        device = bench.make(SimAxes, name, {"axis": [SERVO | {"k": 0.0, "model_file": str(file)}]})
        bench.run(0.2)
        moved.append(device.blocks[1].data[0])
        (block,) = [b for b in SimAxes.describe(name, device.settings).blocks if b.name == "plant"]
        sums.append(block.channels[0].description)
    # 5 N do not overcome 9 N of friction; without it they move 2 kg by 5 N/2 kg (0.2 s)^2/2, less what 4 N s/m take.
    assert moved[0] == 0.0
    assert moved[1] == pytest.approx(0.05 * (1 - 4 / 2 * 0.2 / 3), rel=0.05)
    assert "model" in sums[0]
    assert sums[0] != sums[1]


def test_a_model_of_another_kind_of_axis_is_refused(tmp_path):
    file = tmp_path / "m.toml"
    file.write_text(MODEL.replace("{on}", "true").replace("linear", "rotary"))
    for path, words in ((file, "of a rotary axis"), (tmp_path / "none.toml", "No such file")):
        table = {"axis": [SERVO | {"model_file": str(path)}]}
        with pytest.raises(ValueError, match=words):
            SimAxes.describe("mod0", msgspec.convert(table, SimAxes.Settings))


@pytest.mark.parametrize(
    "table, words",
    [
        ({"axis": []}, "axis: none given"),
        ({"axis": [{k: v for k, v in SERVO.items() if k != "motor"}]}, "neither or both"),
        ({"axis": [SERVO | {"motor": {"mass": -1.0}}]}, "axis x: motor: mass -1"),
        ({"axis": [SERVO | {"acceleration_max": float("inf")}]}, "acceleration_max inf; want what the axis can do"),
        ({"axis": [SERVO | {"bandwidth_hz": 500.0}]}, "bandwidth_hz 500"),
        ({"axis": [SERVO], "beam": [{"boxes": [{"y": [0, 1]}]}]}, "no axis y"),
        ({"axis": [SERVO], "beam": [{"boxes": [{"x": [1, 0]}]}]}, "low first"),
        ({"axis": [SERVO], "effects": {"y": {}}}, "no such axis"),
        ({"axis": [SERVO], "effects_file": "/nowhere.toml"}, "No such file"),
    ],
)
def test_bad_settings_are_told_by_describe(table, words):
    with pytest.raises(ValueError, match=words):
        SimAxes.describe("mod0", msgspec.convert(table, SimAxes.Settings))


@pytest.mark.parametrize("change", [{"masss": 1.0}, {"motor": {"mass": 1.0, "coulumb": 1.0}}, {"homing": {"velo": 1}}])
def test_unknown_keys_are_errors_at_every_depth(change):
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"axis": [SERVO | change]}, SimAxes.Settings)


@pytest.mark.parametrize("bandwidth_hz", [10.0, 30.0, 60.0])
def test_a_starved_machine_moves_as_a_free_one(bench, bandwidth_hz):
    """Ticks 10 to 80 ms apart, as on a machine with much else to do: the controller's turns are made up for."""
    axis = SERVO | {
        "following_error_max": 0.02,
        "jerk_max": 120.0,
        "velocity_max": 0.6,
        "acceleration_max": 6.0,
    }
    mod = bench.make(SimAxes, "mod0", {"axis": [axis, axis | {"name": "y"}]})
    mod.make_up_ns = 10**12
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode.POSITION, position=0.3)
    random, now_ns, worst = np.random.default_rng(1), bench.clock_ns, 0.0
    for _ in range(60):
        now_ns += int(random.integers(10, 80)) * 1_000_000
        mod.tick(now_ns)
        worst = max(worst, abs(mod.bank.rows["following_error"][0]))
    assert not status(mod) & AxisStatus.FAULT and mod.bank.is_idle([0])
    assert mod.bank.rows["position"][0] == pytest.approx(0.3, abs=2e-4)
    assert worst < 2 * 6.0 / (2 * np.pi * bandwidth_hz) ** 2 + 0.002


def test_a_late_tick_shows_every_turn_that_it_makes_up_for(bench):
    """Another device's beam sees an axis that came and went meanwhile."""
    mod = bench.make(SimAxes, "mod0", {"axis": [SERVO]})
    mod.make_up_ns = 10**12
    box = {"bit": 0, "boxes": [{"mod0.plant.x_position": [0.0045, 0.2]}]}
    io = bench.make(SimIo, "io0", {"inputs": 1, "beam": [box]})
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode.POSITION, position=0.0055)
    bench.write(mod, control_mode=ControlMode.POSITION, position=0.0)
    bench.clock_ns += 45_000_000
    bench.run(0.001)
    turns = [stamp for stamp, _ in bench.shown(mod.blocks[1])][-20:]
    assert max(np.diff(turns)) <= 4_000_000
    bench.clock_ns += 45_000_000
    bench.run(0.5)
    assert [value for value, _ in bench.published if value] == [1], "broken once"
    assert io.blocks[0].edges[0] == 2


@pytest.mark.parametrize("verb", ["stop", "emergency_stop", "replace"])
def test_no_verb_has_set_points_run_ahead_of_a_late_world(bench, verb):
    mod = bench.make(SimAxes, "mod0", {"axis": [SERVO | {"following_error_max": 0.05}], "late_max_s": 0.1})
    mod.make_up_ns = 10**12
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode.VELOCITY, velocity=0.5)
    bench.run(0.3)
    bench.clock_ns += 90_000_000
    if verb == "replace":
        record = np.zeros(1, numpy_dtype(NodeClass.AXIS))
        record["control_mode"], record["position"] = int(ControlMode.POSITION), 0.0
        mod.bank.take(verdict(mod.bank.judge(record, [0], bench.clock_ns, replace=True)), bench.clock_ns)
    else:
        getattr(mod.bank, verb)([0], bench.clock_ns)
    bench.run(0.001)
    turns = bench.shown(mod.blocks[0], 95)
    steps = np.diff([fields["commanded_position"] for _, fields in turns]) / np.diff([stamp for stamp, _ in turns])
    assert max(abs(steps)) < 0.51e-9, "no further than a turn goes at 0.5 m/s"
    assert not status(mod) & AxisStatus.FAULT


def test_a_machine_that_is_too_slow_shows_its_axes_in_slow_motion_and_ends_each_tick(bench):
    mod = bench.make(SimAxes, "mod0", {"axis": [SERVO], "late_max_s": 30.0})
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode.VELOCITY, velocity=0.1)
    bench.run(0.2)
    mod.make_up_ns = 0  # one turn a tick
    began_ns, began = bench.clock_ns, float(mod.bank.rows["commanded_position"][0])
    bench.clock_ns += 200_000_000
    for tick in range(20):
        bench.clock_ns += 1_000_000
        mod.tick(bench.clock_ns)
        world_ns = mod.blocks[0].stamp_ns
        assert world_ns == mod.blocks[1].stamp_ns == began_ns + (tick + 1) * mod._world.stride * 1_000_000
        went = float(mod.bank.rows["commanded_position"][0]) - began
        assert went == pytest.approx(0.1 * (world_ns - began_ns) * 1e-9, rel=1e-6)
    mod.make_up_ns = 10**12
    bench.run(0.001)
    assert mod.blocks[0].stamp_ns == 0, "of the tick again"
    went = float(mod.bank.rows["commanded_position"][0]) - began
    assert went == pytest.approx(0.1 * (bench.clock_ns - began_ns) * 1e-9, rel=1e-6)


@pytest.mark.parametrize("column, value", [("velocity", 0.3), ("position", 0.4)])
def test_a_machine_that_is_too_slow_for_long_stops_its_axes_and_says_why(bench, column, value):
    """It falls no further behind than late_max_s, and nothing goes faster than the limits meanwhile."""
    mod = bench.make(SimAxes, "mod0", {"axis": [SERVO], "late_max_s": 0.2})
    mod.make_up_ns = 0
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode[column.upper()], **{column: value})
    for _ in range(60):  # one turn each; while it accelerates, the plan passes 0.3 m/s after 60 ms
        bench.run(0.001)
    fastest = 0.0
    for _ in range(12):
        bench.clock_ns += 30_000_000
        bench.run(0.001)
        assert bench.clock_ns - mod._world.last_ns <= 230_000_000
        fastest = max(fastest, abs(mod._world.servos.velocity[0]))
    assert status(mod) & AxisStatus.FAULT
    assert "simulated time is" in mod.bank.fault_text(0) and "at most 200 ms" in mod.bank.fault_text(0)
    mod.make_up_ns = 10**12
    for _ in range(1000):
        bench.run(0.001)
        fastest = max(fastest, abs(mod._world.servos.velocity[0]))
    assert fastest < 0.51 and mod._world.servos.velocity[0] == 0.0
    mod.bank.reset([0])
    bench.write(mod, control_mode=ControlMode.POSITION, position=0.0)
    bench.run(3.0, until=lambda: mod.bank.is_idle([0]))
    assert mod.bank.rows["position"][0] == pytest.approx(0.0, abs=1e-4), "and can be used again"


def test_a_world_that_is_late_and_at_rest_has_nothing_to_make_up_for(bench):
    mod = bench.make(SimAxes, "mod0", {"axis": [SERVO], "late_max_s": 30.0})
    bench.run(0.01)
    bench.write(mod, control_mode=ControlMode.POSITION, position=0.02)
    bench.run(2.0, until=lambda: mod.bank.is_idle([0]))
    bench.run(0.5)
    mod.make_up_ns = 0
    bench.clock_ns += 5_000_000_000
    bench.run(0.003)
    assert mod.blocks[0].stamp_ns == 0, "it is not late any more"
    assert mod.bank.rows["position"][0] == pytest.approx(0.02, abs=1e-4)


@pytest.mark.parametrize("late_ms", [0, 3, 449, 450])
def test_what_begins_at_rest_is_not_run_backwards_by_a_tick_of_before(bench, late_ms):
    """In a process of several devices a tick may come long after its instant, and behind a write."""
    mod = bench.make(SimAxes, "mod0", {"axis": [SERVO | {"following_error_max": 0.05}], "late_max_s": 2.0})
    bench.run(0.01)
    mod.is_at_rest()
    bench.run(0.5)
    assert mod.is_at_rest()
    due_ns = bench.clock_ns + 1_000_000
    bench.clock_ns += 450_000_000
    record = np.zeros(1, numpy_dtype(NodeClass.AXIS))
    record["control_mode"], record["velocity"], record["time"] = int(ControlMode.VELOCITY), 0.05, 9.0
    at_ns = bench.clock_ns + 380_000
    mod.bank.take(verdict(mod.bank.judge(record, [0], at_ns)), at_ns)
    stamps, shown = [], []
    for at_ns in (
        due_ns,
        due_ns + (450 - late_ms) * 1_000_000,
        *(bench.clock_ns + n * 1_000_000 for n in range(1, 30)),
    ):
        mod.tick(at_ns)
        stamps.append(mod.blocks[0].stamp_ns or at_ns)
        shown.append((float(mod.bank.rows["commanded_velocity"][0]), float(mod.bank.rows["commanded_position"][0])))
    assert stamps == sorted(stamps)
    velocities, positions = zip(*shown, strict=True)
    assert min(velocities) >= 0.0 and 0.049 < max(velocities) <= 0.05 + 1e-9
    assert min(positions) >= -1e-9 and max(positions) <= 0.05 * 0.03
    assert not status(mod) & AxisStatus.FAULT


def test_what_describe_has_built_goes_to_one_device_of_the_same_settings(bench):
    def settings(mass):
        return msgspec.convert({"axis": [SERVO | {"motor": {"mass": mass}}]}, SimAxes.Settings)

    light, heavy = settings(1.0), settings(4.0)
    SimAxes.describe("mod0", light)
    devices = [SimAxes("mod0", each, bench) for each in (heavy, light, light)]
    SimAxes.describe("mod0", light)
    devices += [SimAxes("mod0", each, bench) for each in (light, heavy)]
    light_k, heavy_k = devices[1].bank.settings[0].k, devices[0].bank.settings[0].k
    assert [device.bank.settings[0].k for device in devices] == [heavy_k, light_k, light_k, light_k, heavy_k]
    assert heavy_k > 3 * light_k
    assert len({id(device._world.servos) for device in devices}) == len(devices), "each has a world of its own"
