"""A tick of stepper motors; the model is in stepper.py."""

from __future__ import annotations

import math

from sioms.native.language import Flags, Floats, Record, step
from sioms.native.numbers import nearest

from .friction_step import Friction, glide, keep


class Steppers(Record):
    """n steppers: ``goal`` that they are told, ``field`` where it is, ``move`` of the field in this tick, ``position``
    and ``velocity`` of the rotors; ``micro`` microstep, ``wave_number`` of the holding force, ``hold`` the force at
    rest and ``strength`` of this tick; ``reading`` what the drives know; ``stalled`` and ``lost_steps``; ``rested``
    when the field did not move in the last tick.
    """

    n: int
    substeps: int
    substep_s: float
    tick_s: float
    rested: int
    rotors: Friction
    goal: Floats
    field: Floats
    move: Floats
    strength: Floats
    position: Floats
    velocity: Floats
    micro: Floats
    full_step: Floats
    wave_number: Floats
    hold: Floats
    load_force: Floats
    per_corner: Floats
    viscous: Floats
    rate: Floats
    encoder_step: Floats
    reading: Floats
    stalled: Flags
    lost_steps: Floats
    limit_minus: Floats
    limit_plus: Floats
    home: Floats
    at_minus: Flags
    at_plus: Flags
    at_home: Flags


@step
def turn(s: Steppers) -> int:
    """Turn the fields to the microsteps next to their goals, evenly over one tick."""
    at_rest = s.rested
    moving = 0
    for i in range(s.n):
        s.goal[i] = nearest(s.goal[i] / s.micro[i]) * s.micro[i]
        s.move[i] = s.goal[i] - s.field[i]
        if s.move[i] != 0.0:
            moving = 1
        if s.velocity[i] != 0.0:
            at_rest = 0
    # Rotors that rest on a resting field stay there: their force stays below stiction.
    if moving or not at_rest:
        for i in range(s.n):
            speed = s.move[i] * s.per_corner[i] / s.tick_s
            s.strength[i] = s.hold[i] / math.sqrt(speed * speed + 1.0)
        for k in range(s.substeps):
            swing(s, (k + 0.5) / s.substeps)
    s.rested = 0 if moving else 1
    for i in range(s.n):
        s.field[i] = s.goal[i]
    return know(s)


@step
def swing(s: Steppers, share: float) -> int:
    """Step the rotors under the field at the middle of a substep, this share of the tick from its beginning."""
    f = s.rotors
    for i in range(s.n):
        velocity = s.velocity[i]
        lag = s.move[i] * share + s.field[i] - (velocity * (s.substep_s / 2.0) + s.position[i])
        # Mean of the sine over the substep: no false locking where the field slips far in one.
        slip = s.move[i] * (s.wave_number[i] / (2.0 * s.substeps)) - velocity * (s.wave_number[i] * s.substep_s / 2.0)
        mean = math.sin(slip) / slip if slip != 0.0 else 1.0
        force = math.sin(lag * s.wave_number[i]) * mean * s.strength[i] + s.load_force[i]
        if not s.stalled[i]:
            # In step the rotor is damped against the field, with its force at most, instead of against the ground: the
            # friction step brakes by b v; adding clip(b (v_field - v)) + b v leaves the clipped part.
            brake = velocity * s.viscous[i]
            relative = s.move[i] * (s.viscous[i] / s.tick_s) - brake
            force += brake + max(min(relative, s.strength[i]), -s.strength[i])
        f.force[i] = force
    glide(f)
    return keep(f)


@step
def know(s: Steppers) -> int:
    """Set reading, step loss and switches."""
    for i in range(s.n):
        s.reading[i] = s.field[i]
        if s.encoder_step[i] > 0.0:
            s.reading[i] = nearest(s.position[i] / s.encoder_step[i]) * s.encoder_step[i]
        lag = (s.field[i] - s.position[i]) / s.full_step[i]
        # Half an electrical turn behind: the field pulls backwards.
        if abs(lag - s.lost_steps[i]) > 2.0:
            s.stalled[i] = True
        # A rotor that rests under a resting field has locked again; the steps behind it are lost.
        if s.stalled[i] and s.move[i] == 0.0 and abs(s.velocity[i]) < 0.1 * s.full_step[i] * s.rate[i]:
            s.stalled[i] = False
            s.lost_steps[i] = 4.0 * nearest(lag / 4.0)
        s.at_minus[i] = s.position[i] <= s.limit_minus[i]
        s.at_plus[i] = s.position[i] >= s.limit_plus[i]
        s.at_home[i] = s.position[i] <= s.home[i]
    return 0
