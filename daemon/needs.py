"""How much of the processors the drivers of a workcell need, told before the first tick and not by faults.

An estimate: the processor time of a tick as it was measured for each kind of driver (docs/decisions/0351 and 0570),
times the rate. A slower machine needs more, effects and transmissions of simulated axes too.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from sioms.protocol.flags import NodeClass

from .config import Config
from .names import DeviceInfo, NameTable
from .realtime import SHARE

PERIOD, RUNTIME = "/proc/sys/kernel/sched_rt_period_us", "/proc/sys/kernel/sched_rt_runtime_us"
NAMED = 4
"""Of the devices that need most, how many are named."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Processor time of a tick.

    Attributes:
        warm: when the last one was just before [us].
        cold: when other work has run since [us].
    """

    warm: float
    cold: float


COLD_BELOW_HZ = 200.0
"""Rate at and below which each tick begins with cold caches; above, the part of them that is cold falls as 1/rate."""
COSTS = {"compiled": Cost(25, 80), "tick": Cost(60, 280), "stream": Cost(95, 280)}
"""Of a device by the kind of its driver: a driver whose quiet ticks are compiled, one that ticks in Python, and one
whose device sends by itself."""
AXES_IN_PYTHON = Cost(150, 400)
"""Of a driver that ticks axes in Python."""
POLLED = {NodeClass.AXIS: 2000.0, NodeClass.ANALOG: 600.0, NodeClass.BINARY: 600.0}
"""Of a poll on a line, for each axis and each other block, warm or cold [us]."""


@dataclass(frozen=True, slots=True)
class Machine:
    """What drivers may have.

    Attributes:
        processors: how many there are.
        realtime: of them, what drivers in real-time classes may use together.
    """

    processors: int
    realtime: float


def this_machine() -> Machine:
    """Return what this process may use, and what daemon and kernel leave to real-time classes of it."""
    processors = len(os.sched_getaffinity(0))
    try:
        with open(PERIOD) as period, open(RUNTIME) as runtime:
            allowed_us, of_us = int(runtime.read()), int(period.read())
    except (OSError, ValueError):
        allowed_us, of_us = -1, 1
    throttle = allowed_us / of_us if 0 <= allowed_us <= of_us else 1.0
    return Machine(processors, min(SHARE, throttle) * processors)


def need(device: DeviceInfo) -> float:
    """Return about how much of a processor a device needs while all of it moves; 1 is one processor."""
    axes = any(block.node_class is NodeClass.AXIS for block in device.blocks)
    if device.kind == "line":
        tick_us = sum(
            POLLED[block.node_class] * (len(block.channels) if block.node_class is NodeClass.AXIS else 1)
            for block in device.blocks
        )
    else:
        cost = AXES_IN_PYTHON if device.kind == "tick" and axes else COSTS.get(device.kind, COSTS["tick"])
        cold = min(1.0, COLD_BELOW_HZ / device.tick_hz)
        tick_us = cost.warm + cold * (cost.cold - cost.warm)
    return device.tick_hz * tick_us / 1e6


def summary(needs: Mapping[str, float], machine: Machine) -> str:
    """Return what the devices need, in one sentence."""
    return f"its drivers need about {sum(needs.values()):.2f} of {_processors(machine)}: {_greediest(needs)}"


def shortages(needs: Mapping[str, float], realtime: Iterable[str], machine: Machine) -> list[str]:
    """Return a sentence for each reason why devices do not fit on a machine; none when they do.

    Args:
        needs: of each device.
        realtime: names of the devices whose drivers ask for a real-time class.
        machine: that they shall run on.
    """
    found = [
        f"device {name} needs about {each:.2f} processors, and its driver can use one; "
        f"at most {1 / each:.0%} of its rate fit: lower its rate"
        for name, each in needs.items()
        if each > 1.0
    ]
    total = sum(needs.values())
    if total > machine.processors:
        found.append(
            f"these devices need about {total:.2f} of {_processors(machine)}: {_greediest(needs)}; "
            "lower their rates, or give some of them to another machine"
        )
    prompt = {name: needs[name] for name in realtime if name in needs}
    together = sum(prompt.values())
    if together > machine.realtime:
        found.append(
            f"these devices need about {together:.2f} processors in real time, which may use {machine.realtime:.2f} of "
            f"{_processors(machine)}: {_greediest(prompt)}; lower their rates, or set realtime_priority = 0 for those "
            "that may be late"
        )
    return found


def crowded(needs: Mapping[str, float], config: Config) -> list[str]:
    """Return a sentence for each process of several devices that needs more than one processor."""
    found = []
    for process in sorted({device.common.process for device in config.devices.values()} - {""}):
        inside = {name: each for name, each in needs.items() if config.devices[name].common.process == process}
        total = sum(inside.values())
        if total > 1.0 and len(inside) > 1:
            found.append(
                f"process {process} needs about {total:.2f} processors, and can use one: {_greediest(inside)}; "
                "give some of its devices another process"
            )
    return found


def priorities(names: NameTable, config: Config) -> dict[str, int]:
    """Return the real-time priority of each device's driver, 0 for none.

    The configuration has the last word, then the driver. A device made of devices comes one below the first of what it
    holds: real axes do not wait for an ordinary process to stop them, and not for a long tick of their holder either.
    """
    own = {name: info.realtime_priority for name, info in names.devices.items()}
    given = {name: config.devices[name].common.realtime_priority for name in own}
    own |= {name: priority for name, priority in given.items() if priority is not None}
    found = {}
    for name, priority in own.items():
        below = [own[each] for each in names.made_of(name) - {name} if each in own]
        held = max(below, default=0)
        found[name] = priority if given[name] is not None else max(priority, held - 1, min(held, 1))
    return found


def told(names: NameTable, config: Config, machine: Machine) -> tuple[str, list[str]]:
    """Return what the drivers of a configuration need, and why that does not fit on a machine, where it does not."""
    needs = {name: need(info) for name, info in names.devices.items()}
    realtime = [name for name, priority in priorities(names, config).items() if priority]
    found = shortages(needs, realtime, machine)
    return summary(needs, machine), found + crowded(needs, config)


def _processors(machine: Machine) -> str:
    return f"{machine.processors} processor{'' if machine.processors == 1 else 's'}"


def _greediest(needs: Mapping[str, float]) -> str:
    """Name the devices that need most."""
    ranked = sorted(needs.items(), key=lambda each: -each[1])
    told = ", ".join(f"{name} {each:.2f}" for name, each in ranked[:NAMED])
    rest = len(ranked) - NAMED
    return f"{told} and {rest} more" if rest > 0 else told
