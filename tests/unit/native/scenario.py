"""Runs axes over simulated motors through all that steps do, and prints what came of it, bit for bit."""

import hashlib

import numpy as np

from sioms.motion import AxisBank, AxisKind, AxisSettings, CommandError, Homing
from sioms.motion.plan_step import go_on, may_go_on
from sioms.motion.stop_step import rest_stopped, stop_axes
from sioms.native import language
from sioms.plant.effects import build_effects
from sioms.plant.motor import MotorBank
from sioms.plant.outline import polygon
from sioms.plant.parameters import Motor, Wall
from sioms.plant.planar import Body, Mount, World
from sioms.plant.stepper import Stepper, StepperBank
from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.records import numpy_dtype

MODES = (
    (ControlMode.POSITION, "position", 0.3),
    (ControlMode.POSITION | ControlMode.RELATIVE, "position", 0.05),
    (ControlMode.VELOCITY, "velocity", 0.4),
    (ControlMode.FORCE, "force", 6.0),
    (ControlMode.FORCE_VELOCITY, "force_velocity", 10.0),
)


class NoMarkers:
    def capture(self, token_or_number, *, signal):
        raise AssertionError

    def state(self, number, generation):
        return None

    def signal(self, number, generation, now_ns): ...


def main():
    rng = np.random.default_rng(11)
    servo = {"k": 2e4, "kz": -0.97, "force_max": 30.0, "following_error_max": 0.05, "homing": Homing(0.1, 0.01)}
    settings = [
        AxisSettings("a", position_min=-0.4, position_max=0.4, velocity_max=0.5, acceleration_max=5.0, **servo),
        AxisSettings("b", velocity_max=0.5, acceleration_max=5.0, ki=1e3, kb=-3.0, kp=0.1, **servo),
        AxisSettings("c", velocity_max=0.5, acceleration_max=5.0, jerk_max=100.0, **servo),
        AxisSettings("d", kind=AxisKind.STEPPER, velocity_max=0.5, acceleration_max=5.0, start_velocity=0.01),
        AxisSettings("e", kind=AxisKind.STEPPER, velocity_max=0.5, acceleration_max=5.0, k=300.0, kz=-0.2, kb=0.1),
    ]  # fmt: skip
    motors = [
        Motor(1.0, viscous=4.0, coulomb=1.0, stiction=2.0, encoder_step=1e-6, stop_minus=-0.5, stop_plus=0.5),
        Motor(1.5, encoder_step=1e-5, index_pitch=0.01, limit_plus=0.3, limit_minus=-0.3, home=0.0),
        Motor(0.8, coulomb=0.5, wall=Wall(0.2, 2e4, 10.0), force_constant=1.0, resistance_ohm=1.0, supply_v=25.0),
    ]
    waves = {"x0": {"encoder_eccentricity": {"amplitude": 1e-5, "pitch": 0.1}, "encoder_scale": {"gain": 1.001}}}
    effects = build_effects(waves, ["x0", "x1", "x2"])
    plants = [MotorBank(motors, 1e-3), MotorBank(motors, 1e-3, effects)]
    coils = [Stepper(0.1, 1e-3, hold_force=5.0, coulomb=0.2), Stepper(0.02, 2e-3, hold_force=1.0, encoder_step=1e-5)]
    rotors = [StepperBank(coils, 1e-3) for _ in plants]
    banks = [AxisBank(settings, tick_s=1e-3, markers=NoMarkers()) for _ in plants]
    now, digest, refused, braked, left = 1_000_000_000, hashlib.sha256(), 0, 0, 0
    reading, switches = np.zeros(5), np.zeros(5, dtype=np.int64)
    for tick in range(6000):
        now += 1_000_000 if rng.random() < 0.98 else int(rng.integers(200_000, 3_000_000))
        for bank, plant, rotor in zip(banks, plants, rotors, strict=True):
            reading[:3], reading[3:] = plant.encoder.position, rotor.reading
            switches[:3] = plant.switches
            if tick % 3 and bank.is_quiet():
                left += not may_go_on(bank.plans, now) or go_on(bank.plans, now)
                bank.after_quiet()
            out = bank.tick(now, reading, switches if tick % 3 else None)
            plant.advance(out[:3])
            rotor.advance(out[3:] if tick < 4000 else out[3:] * 1.5)
            digest.update(bank.fields.tobytes() + out.tobytes() + plant.position.tobytes() + rotor.position.tobytes())
        if rng.random() < 0.02:
            mode, column, most = MODES[int(rng.integers(len(MODES)))]
            record = np.zeros(1, numpy_dtype(NodeClass.AXIS))
            record["axis"], record["control_mode"] = rng.integers(5), int(mode)
            record[column] = rng.uniform(-most, most)
            for bank in banks:
                try:
                    bank.append(record, range(5), now, replace=bool(tick % 2))
                except CommandError:
                    refused += 1
        if tick < 3000 and tick % 50 == 24:
            for bank in banks:
                bank.plan_ahead()
                if bank.is_quiet() and stop_axes(bank.plans, now + 300_000, 1) == 0:
                    rest_stopped(bank.plans, now + 600_000)
                    bank.after_quiet()
                    braked += 1
                bank.emergency_stop(range(5), now + 700_000)
                bank.reset(range(5))
        if tick % 500 == 499:
            for bank in banks:
                (bank.stop if tick % 1000 == 999 else bank.emergency_stop)([tick // 500 % 5], now)
                bank.reset(range(5))
    squeeze(digest)
    assert braked > 25, "most stops are begun by steps"
    kinds = sorted({event.kind.name for bank in banks for event in bank.take_events()})
    print("compiled" if language.library else "python", digest.hexdigest(), refused + left, *kinds)


def squeeze(digest):
    """Two fingers close on a triangle, squeeze it until it slides, and open."""
    mounts = [Mount(friction=0.6, friction_by_load=((0.2, 1.2), (1.0, 0.9))), Mount(creep=False)]
    corners = [(-0.03, -0.02), (0.03, -0.02), (0.02, 0.02)]
    world = World(Body(polygon(corners, 1e-3)), mounts, [(-0.05, 0.14, -1.57), (0.05, -0.14, 1.57)], (2e-3, -3e-3, 0.5))
    slid = 0
    for tick in range(1500):
        in_m = 2e-5 * (min(tick, 900) - 2 * max(tick - 1200, 0))
        x, turn = 0.05 - in_m, 1.57 + 1e-4 * min(tick, 700)
        world.command([(-x, 0.14, -1.57), (x, -0.14, turn)], 1e-3)
        world.advance(1e-3, 4)
        slid += sum(finger.slides for finger in world.fingers)
        digest.update(np.array([*world.pose, *world.speed, *(f.tangential for f in world.fingers)]).tobytes())
    assert slid > 20 and world.fingers[0].normal == 0.0


if __name__ == "__main__":
    main()
