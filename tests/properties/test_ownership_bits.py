"""Ownership, stops and rights bit by bit, and markers: the real daemon and drivers go where the model goes."""

from __future__ import annotations

import os

from ownership_bits import Tour, bit_cell, explore

STEPS = int(os.environ.get("SIOMS_BIT_STEPS", "1000"))
"""Of 54,540; ``python tests/ownership_bits.py`` goes on."""


def test_no_promise_is_broken_in_any_state_and_the_real_objects_are_in_the_same() -> None:
    graph = explore()
    assert len(graph) > 1000
    with bit_cell() as cell:
        tour = Tour(cell, graph, seed=STEPS)
        assert tour.go(STEPS) < sum(map(len, graph.values()))
        names = {action[0] for action in tour.steps}
        assert names >= {"die", "kill", "crash", "regrant", "open", "close", "write", "stop", "reset", "signal", "free"}
