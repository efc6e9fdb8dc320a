"""Stops of several clients that wait in one queue."""

from __future__ import annotations

import threading

from sioms.gateway.stop_queue import EACH, Stop, StopQueue


def test_a_flood_of_one_keeps_no_stop_of_another_out_or_back() -> None:
    stops = StopQueue()
    taken = [stops.put("cert-0001", Stop("flood", b"%d" % i)) for i in range(10_000)]
    assert sum(taken) == EACH and all(taken[:EACH])
    assert all(stops.put(f"cert-{i:04d}", Stop("s", b"stop")) for i in range(2, 200))
    came = iter(stops)
    assert next(came) == ("cert-0001", Stop("flood", b"0"))
    assert [next(came)[0] for _ in range(198)] == [f"cert-{i:04d}" for i in range(2, 200)]
    assert [next(came)[1].frame for _ in range(EACH - 1)] == [b"%d" % i for i in range(1, EACH)], "in their order"
    assert stops.put("cert-0001", Stop("flood", b"again")), "there is room again"


def test_who_waits_is_woken_by_a_stop_and_by_the_end() -> None:
    stops, came = StopQueue(), list[str]()
    waiting = threading.Thread(target=lambda: came.extend(number for number, *_ in stops))
    waiting.start()
    stops.put("a", Stop("s", b""))
    while not came:
        waiting.join(0.001)
    stops.close()
    waiting.join(20.0)
    assert not waiting.is_alive() and came == ["a"]
