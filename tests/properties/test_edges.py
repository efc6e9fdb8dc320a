"""Edges of a port: each is told, in order, or counted among the lost; none goes by in silence."""

from __future__ import annotations

import random
from typing import Any

import pytest
from own_writes_rig import World, own_time

from sioms.client.node_core import Edges, EdgesLost
from sioms.drivers.sim.io import SimIo
from sioms.protocol.records import BINARY_WRITE


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("history", [4, 16, 256])
@pytest.mark.parametrize("where", ["outputs", "inputs that they are wired to"])
def test_events_and_the_lost_make_the_count(seed: int, history: int, where: str) -> None:
    """Several writes in a tick, ticks without a look, looks without a tick."""
    made: list[World] = []
    chance = random.Random(seed)
    wires = [{"bit": bit, "output_bit": bit} for bit in range(4)]
    with own_time(made):
        table = {"outputs": 4, "inputs": 4, "loop": wires, "history": history}
        made.append(World(SimIo, table, chance))
        world = made[0]
        owner = world.open(0, [0], exclusive=True)
        node: Any = owner.node if where == "outputs" else world.open(1, [0], exclusive=False).node
        truth, told, lost, last = [0], [0], 0, node.read()
        first = last.edges[0]
        for _ in range(600):
            for _ in range(chance.choice([0, 0, 1, 1, 2, 3])):
                value = chance.randrange(16)
                owner.write(BINARY_WRITE.pack(0, 0, value, 0))
                if value != truth[-1]:
                    truth.append(value)
            for _ in range(chance.choice([0, 1, 1, 2, 12])):
                world.tick()
            while chance.random() < 0.8:
                try:
                    event = Edges(node, -1, last).look()
                except EdgesLost as gap:
                    assert gap.lost > 0 and str(gap.lost) in str(gap) and history < 256
                    lost += gap.lost
                    event = gap.event
                if event is None:
                    break
                last = event
                told.append(event.final)
        world.tick()
        for _ in range(len(truth)):
            try:
                event = Edges(node, -1, last).look()
            except EdgesLost as gap:
                lost, event = lost + gap.lost, gap.event
            if event is None:
                break
            last = event
            told.append(event.final)
        assert node.read().edges[0] - first == len(truth) - 1 == len(told) - 1 + lost
        if history == 256:
            assert told == truth and not lost
        else:
            assert lost, "the history is too short for these pauses"
        world.close()
