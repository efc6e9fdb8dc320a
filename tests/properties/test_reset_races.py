"""A request to stop by the stop-request file meets a reset of the workcell at every access of daemon and driver to what
they share: a request that the reset has answered stops nobody after it, and one that is younger than it always holds.
"""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import pytest
from ownership_cell import Cell, cells
from ownership_explorer import begin
from ownership_fakes import CLOCK
from ownership_state import Action

from sioms.protocol import stopfile
from sioms.protocol.latch import Latch
from sioms.timestamps import Timestamps

OWNER, STOPPER, RESETTER, LATER = 0, 1, 0, 2
AXIS = 0
LATE_NS = 10**9


class Died(BaseException):
    """The daemon has been killed."""


class Watched:
    """Words of shared memory, with somebody who is told before each access."""

    def __init__(self, words: Any, before: Callable[[], None]) -> None:
        self._words, self._before = words, before

    def __getitem__(self, index: int) -> Any:
        self._before()
        return self._words[index]

    def __setitem__(self, index: int, value: Any) -> None:
        self._before()
        self._words[index] = value


@contextmanager
def interrupted(latch: Latch, place: int, act: Callable[[], object]) -> Iterator[list[int]]:
    """Have somebody act before one of the accesses to a view of the latch page, and to the stop-request file; yield how
    many are left then, below 0 if he has.
    """
    left, acts = [place], [False]

    def before() -> None:
        if acts[0]:
            return
        left[0] -= 1
        if left[0] == -1:
            acts[0] = True
            act()
            acts[0] = False

    def watched(call: Callable[..., Any]) -> Callable[..., Any]:
        def called(*arguments: Any) -> Any:
            before()
            return call(*arguments)

        return called

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(latch, "_words", Watched(latch._words, before))
        patch.setattr(latch, "_separate", Watched(latch._separate, before))
        for name in ("pread", "pwrite", "fstat"):
            patch.setattr(stopfile.os, name, watched(getattr(os, name)))  # type: ignore[attr-defined]
        yield left


def meetings(
    before: Sequence[Action], inside: str, act: Callable[[Cell], object], *, dies: bool = False
) -> Iterator[tuple[Cell, int, str]]:
    """Have somebody act before each access within a reset by the daemon or a look of the driver; yield, each time, the
    cell as it is then, the place, and what the reset was answered.

    Args:
        before, inside, act: what has happened before, what is interrupted, and by what.
        dies: who is interrupted dies: the daemon when the reset stands in the latch, the driver when it has said that
            it has obeyed.
    """
    for place in itertools.count():
        with cells() as make, pytest.MonkeyPatch.context() as patch:
            cell = make()
            for action in [*begin("nobody owns anything"), ("open", OWNER, AXIS), ("hear", AXIS), ("listen", AXIS)]:
                cell.take(action)
            for action in before:
                CLOCK.now_ns += 20_000_000
                cell.take(action)
            assert cell.server is not None
            sent_ns = CLOCK()
            if inside == "reset":
                patch.setattr(Timestamps, "monotonic_ns", lambda *_, sent_ns=sent_ns: sent_ns)
            mine = cell.server.cell.shared.latch if inside == "reset" else cell._process(AXIS).runtime.latch
            if dies:
                who: Any = mine if inside == "reset" else cell._process(AXIS).runtime.stops._request
                last = "reset" if inside == "reset" else "take"
                patch.setattr(who, last, functools.partial(_die_after, getattr(who, last)))
            answer = ""
            with interrupted(mine, place, functools.partial(act, cell)) as left, suppress(Died):
                answer = cell.reset(RESETTER) if inside == "reset" else cell.tick(AXIS) or ""
            patch.undo()
            if left[0] >= 0:
                assert place > 3
                return
            yield cell, place, answer


def _die_after(call: Callable[..., object], *arguments: object) -> None:
    call(*arguments)
    raise Died


@pytest.mark.parametrize("inside", ["tick", "reset"])
@pytest.mark.parametrize("seen", [False, True])
def test_a_request_that_a_reset_has_answered_is_over(seen: bool, inside: str) -> None:
    before: list[Action] = [("request_stop", STOPPER), ("beat",), *[("tick", AXIS)] * seen]
    second = ("reset", RESETTER) if inside == "tick" else ("tick", AXIS)
    for cell, place, _ in meetings(before, inside, lambda cell: cell.take(second)):
        for action in (("tick", AXIS), ("beat",), ("tick", AXIS)):
            cell.take(action)
        assert cell.server is not None and cell.record is not None
        assert not cell.server.cell.shared.latch.stopped_ns, place
        assert not cell._process(AXIS).runtime.stops.stopped, place
        assert not cell.record.state.workcell, place
        assert cell.take(("move", OWNER, AXIS)) == "done", place


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_request_that_a_reset_has_answered_stops_no_later_daemon(goes_on: bool) -> None:
    """A driver that is late says that it has obeyed the request before; it may die before it looks again."""
    later: list[Action] = [("beat",), ("reset", RESETTER), ("request_stop", LATER), ("beat",), ("reset", RESETTER)]

    def act(cell: Cell) -> None:
        for action in later:
            CLOCK.now_ns += 20_000_000
            assert cell.take(action) != "refused"

    for cell, place, _ in meetings([("request_stop", STOPPER)], "tick", act, dies=not goes_on):
        if goes_on:
            cell.take(("tick", AXIS))
        cell.take(("crash",))
        for device in (0, 1):
            cell.take(("kill", device))
        cell.take(("boot",))
        assert cell.server is not None and not cell.server.cell.shared.latch.stopped_ns, place


@pytest.mark.parametrize(
    ("dies", "looks"),
    [*itertools.product(["nobody", "the daemon", "all"], [False, True]), ("all, and the files are lost", True)],
)
@pytest.mark.parametrize("by", ["client", "client that was late", "driver"])
def test_a_stop_that_is_younger_than_a_reset_holds(by: str, looks: bool, dies: str) -> None:
    """Also of who has looked at the clock before the request that the reset answers, and is written now."""

    def act(cell: Cell) -> None:
        if by != "driver":
            cell.take(("request_stop", LATER, LATE_NS if "late" in by else 0))
        else:
            cell._process(1).runtime.stops.stop_workcell("an input")
        if looks:
            cell.take(("tick", AXIS))

    before: list[Action] = [("request_stop", STOPPER), ("beat",), ("tick", 1)]
    for cell, place, answer in meetings(before, "reset", act, dies=dies != "nobody"):
        if dies != "nobody":
            cell.take(("crash",))
            for device in (0, 1):
                if dies == "the daemon":
                    cell.take(("hear", device))
                    assert cell._process(device).runtime.stops.stopped, (place, answer)
                cell.take(("kill", device))
            if "lost" in dies:  # as by a boot of the machine
                for end in (stopfile.REQUEST, stopfile.TAKEN):
                    os.unlink(cell.path + end)
            cell.take(("boot",))
        else:
            assert cell.take(("move", OWNER, AXIS)) == "refused", (place, answer)
            cell.take(("beat",))
        assert cell.server is not None and cell.record is not None
        assert cell.server.cell.shared.latch.stopped_ns, (place, answer)
        assert cell.record.state.workcell, (place, answer)


def test_who_has_missed_a_stop_stops_also_where_its_reset_is_half_done() -> None:
    """The daemon may be held up in the middle of it; and the stop has been acknowledged."""
    seen: list[bool] = []

    def act(cell: Cell) -> None:
        cell._process(AXIS).runtime.stops.heed()  # as each tick does, whatever the daemon has told
        seen.append(cell._process(AXIS).runtime.driver.moves())  # type: ignore[attr-defined]

    for _, place, answer in meetings([("move", OWNER, AXIS), ("stop", STOPPER)], "reset", act):
        assert answer == "done" and not seen[-1], place
    assert len(seen) > 10
