"""A tick of motors on which nothing acts but drive, constant load and friction, and their encoders."""

from __future__ import annotations

import math

from sioms.native.language import Flags, Floats, Integers, Record, step
from sioms.native.numbers import whole

from .friction_step import Friction, glide, keep


class Encoders(Record):
    """n encoders: ``true`` is the position before them, ``reading`` what they show [m or rad].

    ``amplitude``, ``wave_number`` and ``phase`` of ``waves`` eccentricities (waves n), ``gain``; ``pitch`` of the index
    marks, the ``cell`` between them, ``index`` where one was passed, ``latch`` the reading at it.
    """

    n: int
    waves: int
    has_index: int
    true: Floats
    reading: Floats
    amplitude: Floats
    wave_number: Floats
    phase: Floats
    gain: Floats
    step: Floats
    per_step: Floats
    ideal: Flags
    pitch: Floats
    per_pitch: Floats
    cell: Floats
    index: Flags
    latch: Floats


class Motors(Record):
    """n motors. ``free``: nothing acts on them but drive, load and friction, where they come to no wall and to no limit
    of their supply.

    ``command`` of the drive [N], bounded by ``force_max``; ``position`` and ``velocity`` of motor and load;
    ``speed_per_force`` that a tick gives; a wall each (``wall_stiffness`` 0 where there is none) and a supply, which
    can push ``stall`` less ``loss`` times the speed; stops, switches.
    """

    n: int
    free: int
    bounded: int
    supplied: int
    has_stops: int
    has_switches: int
    tick_s: float
    friction: Friction
    encoders: Encoders
    command: Floats
    force_max: Floats
    drive_force: Floats
    load_force: Floats
    position: Floats
    velocity: Floats
    speed_per_force: Floats
    wall_position: Floats
    wall_stiffness: Floats
    wall_side: Floats
    contact_force: Floats
    stall: Floats
    loss: Floats
    stop_minus: Floats
    stop_plus: Floats
    limit_minus: Floats
    limit_plus: Floats
    home: Floats
    at_minus: Flags
    at_plus: Flags
    at_home: Flags
    switches: Integers


@step
def reading_at(e: Encoders, i: int, true: float) -> float:
    """Return what an encoder shows at a position."""
    shown = true
    for k in range(e.waves):
        j = k * e.n + i
        shown += e.amplitude[j] * math.sin(e.wave_number[j] * true + e.phase[j])
    shown *= e.gain[i]
    if e.ideal[i]:
        return shown
    # The small surplus keeps a position that is a multiple of the step from falling below it.
    return whole(shown * e.per_step[i] + 1e-9) * e.step[i]


@step
def read(e: Encoders) -> int:
    """Read all encoders; latch the reading at the mark between this position and the one before."""
    for i in range(e.n):
        e.reading[i] = reading_at(e, i, e.true[i])
        if e.has_index:
            cell = whole(e.true[i] * e.per_pitch[i])
            e.index[i] = cell != e.cell[i]
            if e.index[i]:
                # The last mark passed is the lower edge of the new cell going up, its upper edge going down.
                mark = cell if cell > e.cell[i] else cell + 1.0
                e.latch[i] = reading_at(e, i, mark * e.pitch[i])
                e.cell[i] = cell
    return 0


@step
def is_free(m: Motors) -> int:
    """Return whether no axis can come to its wall or to the limit of its supply within this tick."""
    if not m.free:
        return 0
    if not m.bounded:
        return 1
    for i in range(m.n):
        # Friction only slows: |v| stays below |v0| + |F| t/m.
        fastest = abs(m.command[i] + m.load_force[i]) * m.speed_per_force[i] + abs(m.velocity[i])
        depth = (m.position[i] - m.wall_position[i]) * m.wall_side[i] + fastest * m.tick_s
        if depth * m.wall_stiffness[i] > 0.0:
            return 0
        if m.supplied and fastest * m.loss[i] + abs(m.command[i]) >= m.stall[i]:
            return 0
    return 1


@step
def bound(m: Motors) -> int:
    """Bound the commands by what the drives can do."""
    for i in range(m.n):
        most = m.force_max[i]
        m.command[i] = max(min(m.command[i], most), -most)
        m.drive_force[i] = m.command[i]
    return 0


@step
def coast(m: Motors) -> int:
    """Step free motors over the whole tick, which is exact, and read what is to be read."""
    f = m.friction
    for i in range(m.n):
        f.force[i] = m.command[i] + m.load_force[i]
    glide(f)
    keep(f)
    for i in range(m.n):
        m.contact_force[i] = 0.0
    hold_at_stops(m)
    return sense(m)


@step
def hold_at_stops(m: Motors) -> int:
    """Put motors that passed an end stop back onto it, at rest."""
    if m.has_stops:
        for i in range(m.n):
            held = max(min(m.position[i], m.stop_plus[i]), m.stop_minus[i])
            if held != m.position[i]:
                m.position[i] = held
                m.velocity[i] = 0.0
    return 0


@step
def sense(m: Motors) -> int:
    """Read encoders and switches."""
    e = m.encoders
    for i in range(m.n):
        e.true[i] = m.position[i]
    read(e)
    if m.has_switches:
        for i in range(m.n):
            m.at_minus[i] = m.position[i] <= m.limit_minus[i]
            m.at_plus[i] = m.position[i] >= m.limit_plus[i]
            m.at_home[i] = m.position[i] <= m.home[i]
            m.switches[i] = (1 if m.at_minus[i] else 0) + (2 if m.at_plus[i] else 0) + (4 if m.at_home[i] else 0)
    return 0
