"""What the driver check says of a driver that does not come up, and of one whose axis falls into fault."""

from __future__ import annotations

import errno
import subprocess
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from sioms.check import check, held_up
from sioms.check.refusal_trials import _tried
from sioms.check.rigs import Axis
from sioms.check.station import LONGEST_PERIOD_S, Station, Unanswered, _crash, _wait_still, wait_for
from sioms.check.trial import TRIES, Failed, Trial, Verdict, attempt

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


def test_who_looks_rarely_is_not_made_to_look_often(monkeypatch: pytest.MonkeyPatch) -> None:
    now, slept = [0.0], list[float]()

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        now[0] += seconds

    monkeypatch.setattr("time.monotonic", lambda: now[0])
    monkeypatch.setattr("time.sleep", sleep)
    wait_for(lambda: False, 1.0, 0.2)
    assert slept == [0.2] * 5 or slept == [0.2] * 6
    slept.clear()
    wait_for(lambda: False, 1.0, 0.003)
    assert slept[0] == 0.003 and slept[-1] == LONGEST_PERIOD_S


class Prepared:
    """A station whose device is disturbed so many times while it is prepared."""

    def __init__(self, times: int, error: Exception) -> None:
        self.left, self.error, self.settled = times, error, 0
        self.wires: list[Any] = []

    def prepare(self) -> None:
        self.left -= 1
        if self.left >= 0:
            raise self.error

    def settle(self) -> None:
        self.settled += 1

    def close(self) -> None:
        pass


FAULTS = OSError(errno.EIO, "WAIT_UNTIL_IDLE on x: alarm 0x85, RS-485 communication time-out")


@pytest.mark.parametrize(
    ("times", "error", "starts"),
    [(0, FAULTS, True), (TRIES - 1, FAULTS, True), (TRIES, FAULTS, False), (1, Unanswered("no answer"), False)],
)
def test_a_device_that_faults_before_the_first_trial_is_prepared_again(
    times: int, error: Exception, starts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its own dead-man, of a host that was held up, as in a trial."""
    made: Any = Prepared(times, error)
    monkeypatch.setattr(check, "Station", lambda *_, **__: made)
    monkeypatch.setattr("sioms.check.line_trials.prepare", lambda station: station.prepare())
    subject: Any = check.Subject("x", Any)  # type: ignore[arg-type]
    (result,) = check.check(subject, only=["noisy"])
    assert (result.name == "noisy") == starts and made.settled >= min(times, TRIES - 1) * isinstance(error, OSError)
    assert starts or result.verdict is Verdict.FAILED


class Busy:
    """A station whose processes have waited so long for a processor at each look [s]."""

    wires = True

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *waited_s: float) -> None:
        looks = iter(waited_s)
        monkeypatch.setattr(held_up, "waited_ns", lambda pid: int(1e9 * next(looks)))
        self.settled = 0

    def processes(self) -> dict[str, int]:
        return {"the driver": 7}

    def settle(self) -> None:
        self.settled += 1

    def exchanges(self, _: int) -> list[str]:
        return []


@pytest.mark.parametrize("error", [Failed("rest", "motion"), OSError(errno.EIO, "nothing for 0.5 s"), Unanswered("no")])
def test_a_trial_is_tried_again_where_the_machine_held_up_what_it_needs(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    fails = iter([True, False])

    def run(_: Station, full: bool) -> str:
        if next(fails):
            raise error
        return "good"

    busy: Any = Busy(monkeypatch, 5.0, 5.6, 5.6)
    found = attempt(Trial("t", "", run), busy, False)
    assert found.verdict is Verdict.PASSED and busy.settled == 1
    assert (
        found.seen.startswith("good; tried again after ") and "(the driver waited 0.6 s for a processor)" in found.seen
    )


def test_a_trial_that_fails_on_a_free_machine_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(_: Station, full: bool) -> str:
        raise Failed("rest", "motion")

    busy: Any = Busy(monkeypatch, 5.0, 5.0 + held_up.HELD_UP_S / 2)
    assert attempt(Trial("t", "", run), busy, False).verdict is Verdict.FAILED and not busy.settled
    always: Any = Busy(monkeypatch, *range(20))
    found = attempt(Trial("t", "", run), always, False)
    assert found.verdict is Verdict.FAILED and always.settled == TRIES - 1, "and one that always fails does fail"


def test_the_kernel_tells_how_long_a_process_waited() -> None:
    with subprocess.Popen(["sleep", "60"]) as sleeper:
        waits = held_up.Waits({"sleeper": sleeper.pid})
        assert waits.longest({"sleeper": sleeper.pid}) == "", "asleep is not held up"
        sleeper.kill()
    assert waits.longest({"sleeper": sleeper.pid}) == "" and waits.longest({}) == ""


def test_calm_is_waited_for_past_a_link_that_is_lost_once_more() -> None:
    stamps = iter(range(100))

    class Seen:
        lost = 2

        def read(self) -> Any:
            self.lost -= 1
            if self.lost >= 0:
                raise OSError(errno.EIO, "the link to its device is lost")
            return SimpleNamespace(stamp_ns=next(stamps) * 100_000_000, in_motion=(0,), position=(0.0,))

    seen = Seen()
    _wait_still(seen, Axis("x"))
    assert seen.lost < -1


@pytest.mark.parametrize("ago", [3, 250])
def test_who_looks_late_is_shown_the_messages_that_a_wrong_reading_was_made_of(
    ago: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last dozen were of long after it; and a driver that is out of step stays so, long after what was bent."""
    log = [(1000 * n, "<>"[n % 2], f"{n % 256:02x}", "") for n in range(1000)]
    log[700] = (*log[700][:3], "9.1 ms late")
    made: Any = Station.__new__(Station)
    made.wires = ["wire"]
    monkeypatch.setattr(Station, "messages", lambda self, count: log[-count:])
    lines = made.exchanges(12, 1000 * (700 + ago))
    assert any("late" in line for line in lines) and len(lines) == 12 + (ago > 12)
    assert lines[-1].split()[3] == f"{(700 + ago) % 256:02x}", "and none of after it"
    assert not any("late" in line for line in made.exchanges(12)) and len(made.exchanges(12)) == 12
