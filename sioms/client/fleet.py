"""A fleet of cells, the blocking face."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext, suppress
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, Self

from sioms.prompt import Briefly
from sioms.protocol.verbs import EmergencyStop

from .cell_verbs import WorkcellVerbs
from .channel import Answer, Call
from .faces import Blocking, begin, run
from .fleet_places import wanted
from .fleet_verbs import FleetError, FleetMarkerVerbs, FleetVerbs
from .undisturbed import Undisturbed
from .workcell import Workcell

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence

__all__ = ["Fleet", "FleetError", "FleetMarker"]
THREADS = 64
"""Cells that are waited for side by side; more take turns."""
MOST_LED_S = 0.05
"""How long answers of all cells are waited for together [s]; then each by itself."""


class _Together:
    """What waits for several cells in the blocking face: requests go out first, other steps have a thread each."""

    def __init__(self) -> None:
        self._threads: ThreadPoolExecutor | None = None

    async def calls(
        self, calls: Sequence[tuple[WorkcellVerbs[Any], Call]], sent: Callable[[], None] | None = None
    ) -> list[Answer | OSError]:
        try:
            return self._calls(calls, sent)
        except BaseException:  # of a signal, at whichever cell it comes: nobody waits for the others any more
            for cell, call in calls:
                cell._channel.abandon(call)
            raise

    def undisturbed(self) -> Undisturbed:
        return Undisturbed()

    def _calls(
        self, calls: Sequence[tuple[WorkcellVerbs[Any], Call]], when_sent: Callable[[], None] | None
    ) -> list[Answer | OSError]:
        carriers = [carrier for cell, _ in calls if (carrier := cell._channel.carrier) is not None]
        if len(carriers) < 2:
            return self._answers(calls, self._send(calls, when_sent))
        from .carrying import Led

        beats_s = [beat_s for cell, _ in calls if (beat_s := cell._channel.keepalive_s)]
        with Led(carriers) as led:
            sent = self._send(calls, when_sent)
            if not any(isinstance(number, OSError) for number in sent):
                led.wait(min([MOST_LED_S, *beats_s]))
        return self._answers(calls, sent)

    def _send(
        self, calls: Sequence[tuple[WorkcellVerbs[Any], Call]], when_sent: Callable[[], None] | None
    ) -> list[int | OSError]:
        sent: list[int | OSError] = []
        is_stop = any(isinstance(call.message, EmergencyStop) for _, call in calls)
        with Briefly() if is_stop else nullcontext():  # who hears of it here shall not hold up those who have not yet
            for cell, call in calls:
                try:
                    sent.append(cell._channel.send(call))
                except OSError as error:
                    sent.append(error)
        if when_sent is not None:
            when_sent()
        return sent

    def _answers(
        self, calls: Sequence[tuple[WorkcellVerbs[Any], Call]], sent: Sequence[int | OSError]
    ) -> list[Answer | OSError]:
        answers: list[Answer | OSError] = []
        for (cell, call), number in zip(calls, sent, strict=True):
            try:
                answers.append(number if isinstance(number, OSError) else cell._channel.wait(number, call))
            except OSError as error:
                answers.append(error)
        return answers

    async def all(self, steps: Sequence[Coroutine[Any, Any, Any]]) -> list[Any]:
        if self._threads is None:
            self._threads = ThreadPoolExecutor(THREADS, "fleet")
        tasks = []
        try:
            for step in steps:
                tasks.append(self._threads.submit(run, step))
            return [task.exception() or task.result() for task in tasks]
        except BaseException:  # of a signal: what has not begun does not begin
            for task, step in zip_longest(tasks, steps):
                if task is None or task.cancel():
                    with suppress(ValueError):  # it has begun all the same
                        step.close()
                else:
                    task.add_done_callback(_let_go)
            raise

    async def connect(self, address: str, name: str) -> Workcell:
        return Workcell(address, name or None)

    def close(self) -> None:
        if self._threads is not None:
            self._threads.shutdown(wait=False, cancel_futures=True)


def _let_go(task: Future[Any]) -> None:
    """Close a session that comes when nobody waits for it any more."""
    if not task.cancelled() and not task.exception() and isinstance(cell := task.result(), Workcell):
        cell.close()


class FleetMarker(Blocking, FleetMarkerVerbs):
    __doc__ = FleetMarkerVerbs.__doc__


class Fleet(Blocking, FleetVerbs[Workcell]):
    """Sessions with several cells. Use it in a ``with`` block, or close it; the end of the process does.

    Args:
        cells: addresses by the names that the cells have, or addresses; the path of a file (``fleet_places``); None for
            $SIOMS_FLEET or the user's own file.
        name: what this client calls itself in messages and lists.
        partial: whether cells may be missing; ``missing`` says why each is.

    Raises:
        OSError: EEXIST, two cells claim one name; EINVAL, a cell has another name than the fleet gives it; FleetError,
            which cells cannot be reached.

    Concurrency: may be used by many threads.
    """

    _MARKER = FleetMarker

    def __init__(
        self, cells: Mapping[str, str] | Iterable[str] | str | None = None, name: str = "", *, partial: bool = False
    ) -> None:
        super().__init__(_Together(), name)
        begin(self._connect, wanted(cells), partial)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
