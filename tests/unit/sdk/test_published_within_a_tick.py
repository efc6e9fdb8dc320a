"""What a driver publishes in the middle of a tick does not claim to show what comes later in it."""

import random
from typing import Any

from own_writes_rig import World, own_time

from sioms.drivers.sim.io import SimIo
from sioms.protocol.records import BINARY_WRITE


def test_each_of_two_writes_of_a_port_shows_when_it_is_shown() -> None:
    made: list[World] = []
    with own_time(made):
        made.append(World(SimIo, {"outputs": 8, "inputs": 8}, random.Random(1)))
        world = made[0]
        block = next(index for index, each in enumerate(world.runtime.blocks) if each.spec.writable)
        port: Any = world.runtime.blocks[block]
        published: list[tuple[int, int]] = []
        publish = world.runtime.pages.publish

        def watch(of: Any, stamp_ns: int, tick: int, as_of_ns: int) -> None:
            if of is port:
                published.append((int(port.data[0]), as_of_ns))
            publish(of, stamp_ns, tick, as_of_ns)

        world.runtime.pages.publish = watch  # type: ignore[method-assign]
        effects = []
        for bit in (0, 1):
            client = world.open(block, [0], exclusive=True, bit=bit)
            client.write(BINARY_WRITE.pack(0, 0, 1, 0))
            effects.append(world.runtime.effects.last_ns)
        world.tick()
        assert [data for data, _ in published] == [0b01, 0b11]
        for data, as_of_ns in published:
            for bit, effect_ns in enumerate(effects):
                assert data >> bit & 1 or as_of_ns < effect_ns
        world.close()
