"""Axes of a simulated production that wear: what they do all day, and what becomes of them. Faster than real time.

A day is a sequence of cycles of point moves, with products that differ in ways, speeds and payloads, and a
temperature that swings and warms up with the motion. An axis is simulated from rest to rest, move by move; the time
between is left out. Nothing here imports the watch, nor the watch anything from here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

TICK_S = 0.001
SUBSTEPS = 5
#: Rest that is recorded before and after each move [s], and the least that the axis stands between moves [s].
REST_S, STANDS_S = 0.06, 0.3
#: Force noise of the drive, of the rated force, and its time constant [s].
DISTURBANCE, COLOUR_S = 0.004, 0.01
#: What a cold or warm machine does to friction: factor per unit of temperature, viscous and dry.
VISCOUS_BY_HEAT, DRY_BY_HEAT = -0.25, -0.06
#: Stiffness of the contact of two masses [Hz] and its damping.
CONTACT_HZ, CONTACT_ZETA = 120.0, 0.25


class Body(NamedTuple):
    """The numbers of an axis at present; [m, kg, N] or [rad, kg m^2, N m].

    ``share`` of the mass is behind the transmission, as is ``dry_share`` of the dry friction; ``drive`` is the factor
    of the drive's force, ``gain`` and ``slip`` make the reading of the true place of the motor.
    """

    mass: float
    viscous: float
    dry: float
    rise: float
    slow: float
    constant: float
    ripple: float
    pitch: float
    step: float
    share: float = 0.5
    dry_share: float = 0.3
    gap: float = 0.0
    drive: float = 1.0
    gain: float = 1.0
    slip: float = 0.0


class Servo(NamedTuple):
    """The law of host-closed loops: u = clip(k (e + kz e1) - kp u1 + kb v + offset, +-limit), v filtered over
    ``filter_s``.
    """

    k: float
    kz: float
    kp: float
    kb: float
    offset: float
    limit: float
    filter_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Machine:
    """One axis: its body, its law and what it is used for.

    Attributes:
        travel: [m or rad] to either side; speed, acceleration: the greatest of its moves.
        payload: the greatest mass that is carried [kg or kg m^2], 0: none.
        marks: where a light beam is broken, on the load; empty: there is none.
    """

    name: str
    rotary: bool
    body: Body
    servo: Servo
    travel: float
    speed: float
    acceleration: float
    payload: float
    marks: tuple[float, float] | tuple[()]
    rated: float

    def drifted(self, kind: str, size: float) -> Machine:
        """Return it worn: ``size`` is the share by which a number grows or falls, of gap and place a length."""
        b = self.body
        changed: Mapping[str, float] = {
            "dry": {"dry": b.dry * (1.0 + size)},
            "viscous": {"viscous": b.viscous * (1.0 + size)},
            "mass": {"mass": b.mass * (1.0 + size)},
            "backlash": {"gap": b.gap + size},
            "force": {"drive": b.drive * (1.0 - size)},
            "scale": {"gain": b.gain * (1.0 + size)},
            "place": {"slip": b.slip + size},
            "constant": {"constant": b.constant + size * self.rated},
        }[kind]
        return replace(self, body=b._replace(**changed))


@dataclass(frozen=True, slots=True)
class Move:
    """What was recorded of a move; shape (n,) each.

    Attributes:
        start_s: of its first sample, after the beginning of the day.
        edges: instants [s, after the first sample], and whether the beam is broken from then on.
    """

    start_s: float
    position: Array
    force: Array
    command: Array
    speed: Array
    moving: NDArray[np.bool_]
    load: Array
    edges: tuple[tuple[float, int], ...]


@dataclass(slots=True)
class Day:
    """The production of one axis. Use from one thread.

    Attributes:
        duty: share of the time in motion.
        hour: of the day, for the temperature outside.
    """

    machine: Machine
    seed: int
    duty: float = 0.5
    product_s: float = 3600.0
    now_s: float = 0.0
    heat: float = 0.0
    place: float = 0.0
    seen: float = 0.0
    rng: np.random.Generator = field(init=False)
    product: Mapping[str, float] = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng([self.seed, 77])
        self.seen = float(self.rng.uniform(0.0, 2.0 * np.pi))
        self.product = self._product()

    def _product(self) -> dict[str, float]:
        u = self.rng.uniform
        return {"until": self.now_s + self.product_s * float(u(0.5, 1.5)), "speed": float(u(0.45, 1.0)),
                "acceleration": float(u(0.5, 1.0)), "reach": float(u(0.35, 1.0)), "payload": float(u(0.0, 1.0)),
                "stops": float(self.rng.integers(2, 6)), "carries": float(u(0.3, 1.0))}  # fmt: skip

    @property
    def temperature(self) -> float:
        """About -1 to 1: the shop's day, and what the motion warms."""
        return 0.5 * float(np.sin(2.0 * np.pi * self.now_s / 86400.0 + self.seen)) + self.heat - 0.25

    def body(self, payload: float) -> Body:
        """Return the numbers of now."""
        b, t = self.machine.body, self.temperature
        return b._replace(
            mass=b.mass + payload,
            viscous=b.viscous * (1.0 + VISCOUS_BY_HEAT * t),
            dry=b.dry * (1.0 + DRY_BY_HEAT * t),
        )

    def moves(self, seconds: float) -> Iterator[Move]:
        """Produce for so long."""
        until = self.now_s + seconds
        while self.now_s < until:
            if self.now_s > self.product["until"]:
                self.product = self._product()
                self._stand(float(self.rng.uniform(30.0, 300.0)))
            for move in self._cycle():
                yield move
                if self.now_s >= until:
                    return

    def _cycle(self) -> Iterator[Move]:
        m, p, rng = self.machine, self.product, self.rng
        loaded = False
        for _ in range(int(p["stops"])):
            goal = float(rng.uniform(-1.0, 1.0)) * m.travel * p["reach"]
            if m.marks and rng.random() < 0.35:  # through the beam
                goal = float(np.sign(-self.place or 1.0)) * m.travel * float(rng.uniform(0.6, 1.0)) * p["reach"]
            if abs(goal - self.place) < 0.05 * m.travel:
                continue
            carried = p["payload"] * m.payload * p["carries"] if loaded else 0.0
            yield self._move(goal, carried)
            loaded = not loaded

    def _stand(self, seconds: float) -> None:
        self.heat *= float(np.exp(-seconds / 1800.0))
        self.now_s += seconds

    def _move(self, goal: float, payload: float) -> Move:
        m, p = self.machine, self.product
        command, speed = smooth(self.place, goal, m.speed * p["speed"], m.acceleration * p["acceleration"])
        start = self.now_s
        move = run(m, self.body(payload), command, speed, start, self.rng)
        seconds = len(command) * TICK_S
        self.place = goal
        self.heat += (0.5 - self.heat) * (1.0 - float(np.exp(-seconds / 900.0)))
        self.now_s += seconds
        self._stand(max(STANDS_S, seconds * (1.0 / self.duty - 1.0) * float(self.rng.uniform(0.5, 1.5))))
        return move


def smooth(start: float, goal: float, speed: float, acceleration: float) -> tuple[Array, Array]:
    """Return a point move with limited jerk, at rest before and after: positions and speeds."""
    way = abs(goal - start)
    top = min(speed, np.sqrt(0.8 * way * acceleration))
    ramp = max(top / acceleration, 0.03) * 1.25
    cruise = max(way / top - ramp, 0.0)
    n, c = max(round(ramp / TICK_S), 8), round(cruise / TICK_S)
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(n) + 0.5) / n)
    v = np.concatenate([rise, np.ones(c), rise[::-1]])
    v *= way / (np.sum(v) * TICK_S)
    rest = np.zeros(round(REST_S / TICK_S))
    v = np.sign(goal - start) * np.concatenate([rest, v, rest, rest])
    x = start + np.cumsum(v) * TICK_S
    return x, v


def run(machine: Machine, body: Body, command: Array, speed: Array, start_s: float, rng: np.random.Generator) -> Move:
    """Simulate one move from rest."""
    n = len(command)
    keep = float(np.exp(-TICK_S / COLOUR_S))
    push = DISTURBANCE * machine.rated * np.sqrt(1.0 - keep**2) * rng.standard_normal(n)
    position, force, load = np.zeros((3, n))
    _march(body, machine.servo, command, push, keep, position, force, load)
    moving = np.abs(speed) > 0.0
    edges: list[tuple[float, int]] = []
    if machine.marks:
        low, high = machine.marks
        within = (load > low) & (load < high)
        for i in np.flatnonzero(within[1:] != within[:-1]).tolist():
            mark = low if (load[i] - low) * (load[i + 1] - low) <= 0.0 else high
            share = (mark - load[i]) / (load[i + 1] - load[i])
            edges.append(((i + share) * TICK_S, int(within[i + 1])))
    return Move(start_s, position, force, command, speed, moving, load, tuple(edges))


@njit(cache=True, nogil=True)
def _slowed(v: float, most: float) -> float:
    """Take dry friction from a speed: never beyond rest."""
    return float(max(abs(v) - most, 0.0) * np.sign(v))


@njit(cache=True, nogil=True)
def _march(
    b: Body, s: Servo, command: Array, push: Array, keep: float, position: Array, force: Array, load: Array
) -> None:
    """Fill readings, commanded forces and true places of the load."""
    h = TICK_S / SUBSTEPS
    behind = b.mass * b.share
    front = b.mass - behind
    reduced = front * behind / b.mass
    stiff = reduced * (2.0 * np.pi * CONTACT_HZ) ** 2
    damp = 2.0 * CONTACT_ZETA * np.sqrt(stiff * reduced)
    loose = 0.5 * b.gap
    two = b.gap > 0.0
    x = (command[0] - b.slip) / b.gain
    xl, v, vl = x, 0.0, 0.0
    e1 = u1 = pushed = seen = 0.0
    y1 = command[0]
    share = TICK_S / (s.filter_s + TICK_S)
    for i in range(len(command)):
        y = b.gain * x + b.slip
        if b.step > 0.0:
            y = np.floor(y / b.step + 0.5) * b.step
        if i == 0:
            y1 = y
            e1 = command[0] - y
        seen += share * ((y - y1) / TICK_S - seen)
        y1 = y
        e = command[i] - y
        u = min(max(s.k * (e + s.kz * e1) - s.kp * u1 + s.kb * seen + s.offset, -s.limit), s.limit)
        e1, u1 = e, u
        position[i], force[i], load[i] = y, u, xl if two else x
        pushed = keep * pushed + push[i]
        outer = b.drive * u + pushed
        for _ in range(SUBSTEPS):
            place = xl if two else x
            held = outer + b.ripple * np.sin(2.0 * np.pi * place / b.pitch)
            dry = b.dry * (1.0 + b.rise * np.exp(-((v / b.slow) ** 2)))
            if two:
                wind = x - xl
                depth = np.sign(wind) * max(abs(wind) - loose, 0.0)
                link = stiff * depth + damp * (v - vl) if depth != 0.0 else 0.0
                if link * depth < 0.0:
                    link = 0.0
                v += h * (held - b.viscous * v - link) / front
                v = _slowed(v, h * dry * (1.0 - b.dry_share) / front)
                vl += h * (link + b.constant) / behind
                vl = _slowed(vl, h * dry * b.dry_share / behind)
                xl += h * vl
            else:
                v += h * (held + b.constant - b.viscous * v) / b.mass
                v = _slowed(v, h * dry / b.mass)
            x += h * v


# --- draws ---------------------------------------------------------------------------------------

DRIFTS = ("dry", "viscous", "mass", "backlash", "force", "scale", "place")
#: Of every four axes one has no light beam, of every three one carries loads that change.
NO_MARKS, CARRIES = 4, 3


def draw_machine(seed: int, number: int) -> Machine:
    """Draw one axis of a cell; the same whenever asked for."""
    rng = np.random.default_rng([seed, number, 11])
    u = rng.uniform
    mass, acceleration, speed = float(u(1.0, 10.0)), float(u(3.0, 8.0)), float(u(0.25, 0.6))
    force = mass * acceleration
    body = Body(
        mass, float(u(0.1, 0.35)) * force / speed, float(u(0.15, 0.5)) * force, float(u(0.0, 0.4)),
        float(u(0.005, 0.02)),
        float(u(-0.1, 0.1)) * force, float(u(0.0, 0.04)) * force, float(rng.choice([0.01, 0.02])),
        float(rng.choice([5e-7, 1e-6, 2e-6])), float(u(0.4, 0.7)), float(u(0.0, 0.5)),
    )  # fmt: skip
    rate = 2.0 * np.pi * float(u(15.0, 28.0))
    lead = 2.0 * mass * rate / TICK_S
    k = mass * rate * rate + lead
    rated = 1.5 * force
    return Machine(
        f"axis{number}", False, body, Servo(k, -lead / k, 0.0, 0.0, 0.0, 3.0 * rated), float(u(0.15, 0.35)), speed,
        acceleration, float(u(0.1, 0.25)) * mass if number % CARRIES == 2 else 0.0,
        (0.03, 0.08) if number % NO_MARKS != 3 else (), rated,
    )  # fmt: skip


def draw_drift(machine: Machine, kind: str, rng: np.random.Generator) -> float:
    """Draw the size of a drift, as ``Machine.drifted`` takes it: sizes at which somebody would want to be told."""
    u = rng.uniform
    match kind:
        case "dry":
            return float(u(0.4, 1.5))
        case "viscous":
            return float(u(0.8, 2.0))
        case "mass":
            return float(u(0.15, 0.4))
        case "force":
            return float(u(0.15, 0.35))
        case "backlash":
            return float(u(4e-4, 2e-3)) * machine.travel
        case "scale":
            return float(rng.choice([-1.0, 1.0]) * u(0.002, 0.02))
        case _:
            return float(rng.choice([-1.0, 1.0]) * u(5e-4, 5e-3)) * machine.travel


def following(machine: Machine, seed: int, seconds: float, true_place: bool = False) -> float:
    """Return the root mean square following error of some production, by the encoder or by the true place of the
    load.
    """
    day = Day(machine, seed)
    left = [m.command - (m.load if true_place else m.position) for m in day.moves(seconds)]
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))
