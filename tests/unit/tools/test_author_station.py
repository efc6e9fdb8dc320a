"""What the driver check says of a driver that does not come up, and of one whose axis falls into fault."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from sioms.check.refusal_trials import _tried
from sioms.check.station import Station, _crash

LOG = r"""time=1 level=info event="device up" device=stage pid=7
time=2 level=error event=driver device=stage text="driver failed: KeyError(8):   File \"a.py\", line 1, in poll     x = y[8]     ~^^^ KeyError: 8 "
time=3 level=error event=driver device=stage text="driver failed: KeyError(9):   File \"a.py\", line 2, in poll     x = y[9]     ~^^^ KeyError: 9 "
time=4 level=error event="device lost" device=stage reason="its driver process ended" then=restarting
"""  # noqa: E501


def test_the_last_crash_is_told_alone() -> None:
    assert _crash(LOG) == 'driver failed: KeyError(9): File "a.py", line 2, in poll x = y[9] KeyError: 9'
    assert _crash(LOG.splitlines()[0]) == ""


FAULT = 'time=5 level=error event=driver device=stage text="fault of x: alarm 0x85"\n'


class Logging:
    """A daemon whose log grows with each look at it."""

    def __init__(self, *parts: str) -> None:
        self._parts: Iterator[str] = iter(parts)
        self._text = ""

    def log(self) -> str:
        self._text += next(self._parts, "")
        return self._text


def station(*parts: str, before: int = 0) -> Station:
    """Return a station of which nothing runs; so many characters of its log are of before the last calm."""
    made: Any = Station.__new__(Station)
    made.daemon, made._log_of_before = Logging(*parts), before
    assert isinstance(made, Station)
    return made


def test_the_reason_of_a_fault_is_waited_for_as_it_is_logged_behind_what_the_axis_shows() -> None:
    assert station(LOG, "", FAULT).last_fault() == "fault of x: alarm 0x85"


def test_a_fault_of_before_the_last_calm_is_not_taken_for_this_one() -> None:
    assert station(FAULT, before=len(FAULT)).last_fault() == ""
    assert station(FAULT, "", FAULT.replace("85", "10"), before=len(FAULT)).last_fault() == "fault of x: alarm 0x10"


def test_every_hindrance_and_every_way_of_stopping_is_tried() -> None:
    nothing = ("request lost", "reply lost", "refused")
    hindrances = [(name, lambda: None, lambda: None) for name in nothing]
    ways = ("stop", "emergency stop", "close")
    for count in (1, 2, 3):
        pairs = [(hindrance[0], way) for hindrance, way in _tried(hindrances[:count], ways, False)]
        assert {name for name, _ in pairs} == set(nothing[:count]) and {way for _, way in pairs} == set(ways)
        assert len(set(pairs)) == 3
        assert len(_tried(hindrances[:count], ways, True)) == 3 * count
    assert len(_tried(hindrances, ways[:2], False)) == 3
