"""Clients of a real driver on a clock of the tests' own, whose requests lie in their sockets until it serves them."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any

from own_writes_devices import Device
from own_writes_rig import CLOCK, Client, World, own_time

from sioms.protocol.driver_verbs import DriverVerb
from sioms.protocol.flags import ControlMode, NodeClass, Request
from sioms.protocol.records import AXIS_WRITE, WRITE, WRITE_STRUCT
from sioms.sdk.stops import SHOWN_NS

AXIS = {"velocity_max": 0.5, "acceleration_max": 5.0, "motor": {"mass": 1.0}, "force_max": 60.0}
LATER_NS = SHOWN_NS // 2


def world(driver: Any, table: dict[str, Any], device: Device | None = None) -> Iterator[World]:
    made: list[World] = []
    with own_time(made):
        made.append(World.__new__(World))
        made[0].__init__(driver, table, random.Random(1), device)  # type: ignore[misc]
        yield made[0]
        made[0].close()


def jog(axis: int, velocity: float = 0.1) -> bytes:
    """Return the record of a move at a velocity."""
    fields = {"axis": axis, "control_mode": int(ControlMode.VELOCITY), "velocity": velocity}
    return AXIS_WRITE.pack(*(fields.get(name, 0) for name in WRITE[NodeClass.AXIS]))


class Sender:
    """A client, and what its requests have been answered, in their order."""

    def __init__(self, world: World, client: Client) -> None:
        self.world, self.client = world, client
        self.answers: list[Any] = []

    def post(self, call: Any) -> None:
        CLOCK.now_ns += LATER_NS
        self.client.post(call, self.answers.append)

    def jog(self, axis: int = 0, velocity: float = 0.1) -> None:
        self.post(self.client.node._write(jog(axis, velocity), 0.0, False))

    def set_bits(self, bits: int, mask: int) -> None:
        self.post(self.client.node._write(WRITE_STRUCT[NodeClass.BINARY].pack(0, 0, bits, mask), 0.0, False))

    def reset(self) -> None:
        self.post(self.client.node._ioctl(Request.RESET, None, None))

    def served(self) -> list[int | None]:
        """Let the driver come to what was sent; return the errnos of the answers, None: done."""
        CLOCK.now_ns += LATER_NS
        handle = self.world.runtime.clients.handles[self.client.node.handle]
        for _ in range(8):
            self.world.runtime.clients._readable(handle)
        self.client.take()
        return [answer.errno if isinstance(answer, OSError) else None for answer in self.answers]


def order(world: World, verb: DriverVerb, channels: list[int], bit: int = -1) -> None:
    CLOCK.now_ns += LATER_NS
    sent = [CLOCK()] * (verb == DriverVerb.NODE_RESET)
    world.order(verb, 0, channels, bit, "eva", world.latch.resets, CLOCK(), *sent)


def stop_and_reset(world: World, channels: list[int], bit: int = -1) -> None:
    order(world, DriverVerb.NODE_STOP, channels, bit)
    order(world, DriverVerb.NODE_RESET, channels, bit)


def fault(world: World, axis: int = 0) -> None:
    """Put an axis in fault, and let everybody see it."""
    CLOCK.now_ns += LATER_NS
    world.runtime.blocks[0].bank.fault([axis], "it jams", CLOCK() - LATER_NS)  # type: ignore[attr-defined]
    world.runtime.publish(world.runtime.blocks[0], CLOCK())


def in_fault(world: World, axis: int = 0) -> bool:
    return bool(world.runtime.blocks[0].bank.is_in_fault(axis))  # type: ignore[attr-defined]
