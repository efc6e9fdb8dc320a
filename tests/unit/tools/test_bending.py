"""What a wire does to requests: lost, with a byte more, with a byte less."""

from __future__ import annotations

import pytest

from sioms.check.bending import STRAY, Bender, Faults

REQUEST = bytes(range(1, 10))


def bent(**faults: float) -> list[bytes]:
    bender = Bender()
    bender.set(Faults(**faults))  # type: ignore[arg-type]
    return [bender.requested(REQUEST)[0] for _ in range(40)]


def test_a_request_reaches_the_device_unless_told_otherwise() -> None:
    assert bent() == [REQUEST] * 40


def test_a_lost_request_reaches_nothing() -> None:
    assert bent(deaf=1.0) == [b""] * 40


def test_a_stray_byte_comes_before_the_request() -> None:
    found = bent(stray=1.0)
    assert {data[:1] for data in found} == set(STRAY)
    assert all(data[1:] == REQUEST for data in found)


def test_a_short_request_lacks_any_one_of_its_bytes() -> None:
    found = bent(short=1.0)
    assert all(len(data) == len(REQUEST) - 1 and set(data) < set(REQUEST) for data in found)
    assert len(set(found)) > 5


@pytest.mark.parametrize("name", ["deaf", "stray", "short"])
def test_so_many_requests_are_hit_and_no_more(name: str) -> None:
    found = bent(**{name: 1.0, "count": 3})
    assert sum(data != REQUEST for data in found) == 3
    assert found[3:] == [REQUEST] * 37
