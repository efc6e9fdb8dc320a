"""The verbs of a fleet: many cells as one; the one list of which both faces are made (``faces``)."""

from __future__ import annotations

import errno
from contextlib import suppress
from time import monotonic, monotonic_ns
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeVar

from sioms.protocol import verbs
from sioms.protocol.clock import Clock, starts
from sioms.protocol.flags import Request
from sioms.protocol.text import printable

from .arguments import number as as_number
from .cell_verbs import NodeEntry, WorkcellVerbs, request_stop, stop_call
from .channel import Answer, Call
from .marks import verb
from .node_verbs import NodeVerbs
from .session import MarkerVerbs
from .wall import wall

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
    from contextlib import AbstractContextManager

    from sioms.protocol.nodeinfo import NodeInfo

    from .node_verbs import AxisVerbs

LEAD_S = 0.05
"""How far ahead a start of several cells lies: long enough for every driver to hear of it [s]."""
WITHIN_S = 100e-6
SLICE_S = 0.5
"""How often a wait in one cell looks whether those in others have failed [s]."""
C = TypeVar("C", bound=WorkcellVerbs[Any])


class Together(Protocol):
    """What waits for several things at once, each face in its own way."""

    async def calls(
        self, calls: Sequence[tuple[WorkcellVerbs[Any], Call]], sent: Callable[[], None] | None = None
    ) -> list[Answer | OSError]:
        """Send a request to each of several cells, then wait for all answers; ``sent`` is called in between."""

    def undisturbed(self) -> AbstractContextManager[Any]:
        """Return what puts off interrupts in a ``with`` block, or until its ``end``; a cancelled task has none."""

    async def all(self, steps: Sequence[Coroutine[Any, Any, Any]]) -> list[Any]:
        """Run coroutines side by side; return what each returns, or raises."""

    async def connect(self, address: str, name: str) -> Any:
        """Open a session with a cell."""

    def close(self) -> None:
        """Let go of everything."""


class FleetError(OSError):
    """Some cells of a fleet have not done what all were asked for.

    Attributes:
        errors: why, by the name of the cell.
    """

    def __init__(self, what: str, errors: Mapping[str, OSError], of: int) -> None:
        told = "; ".join(f"{name}: {error.strerror or error}" for name, error in errors.items())
        first = next(iter(errors.values()))
        super().__init__(first.errno or errno.EIO, f"{what}: {len(errors)} of {of} cells failed: {told}")
        self.errors = dict(errors)


class FleetMarkerVerbs:
    """A marker in every cell of a fleet: ``marker["left"]`` or ``marker[node]`` is that of one cell.

    Commands take that of their own cell. ``signal`` signals all; ``wait`` passes a signal on from the cell
    where it comes to all others.
    """

    def __init__(self, fleet: FleetVerbs[Any], markers: dict[str, Any]) -> None:
        self._fleet = fleet
        self._markers = markers

    def __getitem__(self, of: str | NodeVerbs[Any]) -> Any:
        """Return the marker of a cell, or of that of an open node."""
        return self._markers[of if isinstance(of, str) else self._fleet._cell_of(of)]

    def __repr__(self) -> str:
        return f"<{type(self).__name__} in {', '.join(self._markers)}>"

    @verb
    async def signal(self) -> None:
        """Signal it in all cells."""
        await self._fleet._ask("signal marker", lambda name: verbs.SignalMarker(int(self._markers[name])))

    @verb
    async def wait(self, timeout: float | None = None) -> int:
        """Wait until it is signalled in any cell, and signal it in all others.

        Args:
            timeout: how long [s]; None = for ever.

        Returns:
            When that was [ns, CLOCK_MONOTONIC].

        Raises:
            OSError: ETIMEDOUT; EPIPE, it has been freed; FleetError, a cell has gone.
        """
        deadline = None if timeout is None else monotonic() + as_number("wait for marker: timeout", timeout, "seconds")
        failed: dict[str, OSError] = {}
        steps = [self._wait_in(name, marker, deadline, failed) for name, marker in self._markers.items()]
        try:
            found = [at for at in await self._fleet._together.all(steps) if isinstance(at, int)]
        except BaseException:  # interrupted, or cancelled: those that still wait look at this
            failed[""] = OSError(errno.ECANCELED, "cancelled")
            raise
        if found:
            return min(found)
        raise FleetError("wait for marker", failed, len(self._markers))

    async def _wait_in(self, name: str, marker: Any, deadline: float | None, failed: dict[str, OSError]) -> int | None:
        while True:
            left = SLICE_S if deadline is None else min(SLICE_S, deadline - monotonic())
            try:
                at_ns = await MarkerVerbs.wait(marker, max(0.0, left))
                break
            except OSError as error:
                if error.errno != errno.ETIMEDOUT or failed or (deadline is not None and monotonic() >= deadline):
                    failed[name] = error
                    return None
        others = [each for each in self._markers if each != name]
        await self._fleet._ask("signal marker", lambda each: verbs.SignalMarker(int(self._markers[each])), others, True)
        return at_ns

    @verb
    async def free(self) -> None:
        """Free it in all cells; who waits for it gets EPIPE."""
        await self._fleet._ask("free marker", lambda name: verbs.FreeMarker(int(self._markers[name])))


class FleetVerbs(Generic[C]):
    """The verbs of sessions with several cells; nodes are called ``CELL:NODE``.

    Attributes:
        cells: sessions by the names of the cells.
        missing: why each cell that is not there is not, by its name, or its address where that is not known.
    """

    _MARKER: ClassVar[type[FleetMarkerVerbs]]

    def __init__(self, together: Together, name: str) -> None:
        self.cells: dict[str, C] = {}
        self.missing: dict[str, OSError] = {}
        self._addresses: dict[str, str] = {}
        self._together = together
        self._name = name

    async def _connect(self, wanted: Sequence[tuple[str, str]], partial: bool) -> None:
        """Open a session with each cell."""
        from .fleet_places import claim

        found = await self._together.all([self._together.connect(address, self._name) for _, address in wanted])
        try:
            for (name, address), cell in zip(wanted, found, strict=True):
                if isinstance(cell, OSError):
                    self.missing[name or address] = cell
                elif isinstance(cell, BaseException):
                    raise cell
                else:
                    called = claim(name, cell.name, address, self._addresses)
                    self.cells[called], self._addresses[called] = cell, address
            if self.missing and not partial:
                raise FleetError("open the fleet", self.missing, len(wanted))
        except BaseException:
            for cell in found:
                if isinstance(cell, WorkcellVerbs):
                    await WorkcellVerbs.close(cell)
            self._together.close()
            raise

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {', '.join(self.cells)}>"

    def __getitem__(self, name: str) -> C:
        """Return the session with a cell."""
        return self._of(name, "use the fleet")

    def _of(self, name: str, what: str) -> C:
        if name not in self.cells:
            why = self.missing.get(name)
            text = why.strerror if why else f"no such cell; there are: {', '.join(self.cells) or 'none'}"
            raise OSError(why.errno if why else errno.ENOENT, f"{what}: cell {printable(name)}: {text}")
        return self.cells[name]

    def _node(self, name: str, what: str) -> tuple[C, str]:
        cell, colon, node = name.partition(":")
        if not colon or not node:
            raise OSError(
                errno.EINVAL, f"{what} {printable(name)}: want CELL:NODE, as {next(iter(self.cells), 'left')}:mod0"
            )
        return self._of(cell, f"{what} {printable(name)}"), node

    def _cell_of(self, node: NodeVerbs[Any]) -> str:
        for name, cell in self.cells.items():
            if cell._nodes.get(node.handle) is node:
                return name
        raise ValueError(f"{node.name} is not an open node of this fleet")

    async def _ask(
        self,
        what: str,
        message: Callable[[str], verbs.Message],
        names: Sequence[str] | None = None,
        leave: bool = False,
        undo: Callable[[Any], verbs.Message] | None = None,
    ) -> dict[str, Any]:
        """Ask several cells at once; return the value of each answer.

        Args:
            what: the request in words.
            message: makes that of a cell.
            names: of the cells, None = all.
            leave: whether to leave those out that fail, instead of an error.
            undo: makes what undoes it, of the value of its answer, for those that did it when others failed.
        """
        names = list(self.cells) if names is None else names
        calls = [(self.cells[name], Call(what, message(name))) for name in names]
        answers = dict(zip(names, await self._together.calls(calls), strict=True))
        errors = {name: answer for name, answer in answers.items() if isinstance(answer, OSError)}
        values = {name: answer.value for name, answer in answers.items() if not isinstance(answer, OSError)}
        if errors and not leave:
            if undo is not None:
                await self._together.calls([(self.cells[name], Call(what, undo(values[name]))) for name in values])
            raise FleetError(what, errors, len(names))
        return values

    @verb
    async def close(self) -> None:
        """End all sessions: their nodes are closed and their markers freed."""
        for cell in self.cells.values():
            await WorkcellVerbs.close(cell)
        self._together.close()

    @verb
    async def nodes(self) -> list[NodeEntry]:
        """Return all nodes of all cells that this user may read, by their names in the fleet."""
        return [
            NodeEntry([f"{name}:{packed[0]}", *packed[1:]])
            for name, value in (await self._ask("list nodes", lambda _: verbs.List())).items()
            for packed in value
        ]

    @verb
    async def info(self, name: str) -> NodeInfo:
        """Return what a node is, ``CELL:NODE``, without opening it."""
        cell, node = self._node(name, "get information of")
        return await WorkcellVerbs.info(cell, node)

    @verb
    async def open(
        self,
        name: str,
        mode: str = "r",
        timeout: float | None = 0.0,
        *,
        lease: float = 0.0,
        kind: type[NodeVerbs[Any]] | None = None,
    ) -> Any:
        """Open a node, ``CELL:NODE``; see ``Workcell.open``."""
        cell, node = self._node(name, "open")
        opened: Any = cell.open(node, mode, timeout, lease=lease, kind=kind)  # type: ignore[attr-defined]
        return opened if isinstance(opened, NodeVerbs) else await opened

    @verb
    async def status(self) -> dict[str, dict[str, Any]]:
        """Return the status of each cell by its name; see ``Workcell.status``."""
        values = await self._ask("get status", lambda _: verbs.Status())
        for name, value in values.items():
            if value["stopped_ns"]:
                value["stopped_ns"] = self.cells[name]._here(value["stopped_ns"])
        return values

    # --- stops -----------------------------------------------------------------------------------

    @verb
    async def emergency_stop(self, why: str = "") -> None:
        """Stop every cell, and latch the stops until they are reset; see ``Workcell.emergency_stop_workcell``.

        All are told before any answer is waited for; one whose session has been lost is connected to again.

        Args:
            why: for the logs and for who asks why nothing moves.

        Raises:
            FleetError: which cells have not acknowledged it; all others are stopped. Cells that are missing count.
        """
        why = printable(str(why))
        calls = []
        with self._together.undisturbed() as undisturbed:
            try:
                for cell in self.cells.values():
                    calls.append((cell, stop_call("", why, False, request_stop(cell._request, why))))
                answers = await self._together.calls(calls, undisturbed.end)
            except BaseException:  # cancelled, as a rule: all hear of it before this ends
                self._stop_unasked(why)
                raise
        errors = dict(self.missing)
        for name, (_, call), answer in zip(self.cells, calls, answers, strict=True):
            if isinstance(answer, OSError) and not (call.enough and call.enough()):
                errors[name] = answer
        lost = [
            name for name, error in errors.items() if name in self.cells and error.errno in (errno.EIO, errno.ETIMEDOUT)
        ]
        for name, answer in zip(lost, await self._together.all([self._stop_again(n, why) for n in lost]), strict=True):
            if answer is None:
                del errors[name]
        if errors:
            raise FleetError("emergency stop", errors, len(self.cells) + len(self.missing))

    def _stop_unasked(self, why: str) -> None:
        """Tell all cells to stop, without waiting for their answers; a second time does no harm."""
        for cell in self.cells.values():
            with suppress(OSError):
                call = stop_call("", why, False, request_stop(cell._request, why))
                cell._channel.send(call)
                cell._channel.abandon(call)

    async def _stop_again(self, name: str, why: str) -> None:
        cell = await self._together.connect(self._addresses[name], self._name)
        try:
            await WorkcellVerbs.emergency_stop_workcell(cell, why)
        finally:
            await WorkcellVerbs.close(cell)

    @verb
    async def reset(self) -> None:
        """Clear the latched stops of all cells. Nothing resumes by itself."""
        await self._ask("reset", lambda _: verbs.Reset(""))

    @verb
    async def supervise(self, lease: float) -> dict[str, float]:
        """Supervise every cell for a while; see ``Workcell.supervise``. Returns the lease of each cell by its name."""
        lease_s = as_number("supervise: lease", lease, "seconds")
        return dict(await self._ask("supervise", lambda _: verbs.Supervise(lease_s)))

    # --- together --------------------------------------------------------------------------------

    @verb
    async def reserve_marker(self) -> Any:
        """Reserve a marker in every cell; returns a FleetMarker. They are freed with the sessions."""
        tokens = await self._ask(
            "reserve a marker", lambda _: verbs.ReserveMarker(1, False), undo=lambda made: verbs.FreeMarker(made[0])
        )
        markers = {name: self.cells[name]._MARKER(self.cells[name], token) for name, (token,) in tokens.items()}
        return self._MARKER(self, markers)

    @verb
    async def synch(self, *nodes: AxisVerbs, lead: float = LEAD_S, within: float = WITHIN_S) -> int:
        """Start the waiting commands of nodes of several cells at the same instant.

        It is told to each cell in its own clock, by UTC or by what exchanges with this client have shown, whichever
        is known better. UTC is known as well as the clocks of the cells are kept right by PTP or NTP.

        Args:
            nodes: open axis nodes, of any number of cells.
            lead: how far ahead the instant lies [s].
            within: how far apart the cells may be at most [s].

        Returns:
            The instant [ns, CLOCK_MONOTONIC of this machine].

        Raises:
            OSError: ERANGE, the clocks are not known so well, and nothing has started; ETIME, a driver heard of it
                too late, and the nodes that had started are stopped.
        """
        names = [self._cell_of(node) for node in nodes]
        clocks = {name: self._clock(name) for name in names}
        within_ns = int(as_number("synch: within", within, "seconds") * 1e9)
        start_ns = monotonic_ns() + int(as_number("synch: lead", lead, "seconds") * 1e9)
        try:
            there, _, _ = starts(start_ns, clocks, within_ns)
        except ValueError as error:
            raise OSError(errno.ERANGE, f"synch: {error}") from None
        told = [
            NodeVerbs._ask(node, Request.SEND_EXTERNAL_SYNCH, there[name])
            for node, name in zip(nodes, names, strict=True)
        ]
        try:
            answers = await self._together.all(told)
        except BaseException:  # interrupted, or cancelled, when some may have been told and others not
            await self._stop_all(nodes)
            raise
        if errors := [answer for answer in answers if isinstance(answer, BaseException)]:
            await self._stop_all(nodes)
            raise errors[0]
        return start_ns

    async def _stop_all(self, nodes: Sequence[AxisVerbs]) -> None:
        await self._together.all([NodeVerbs._ask(node, Request.STOP) for node in nodes])

    def _clock(self, name: str) -> Clock:
        clock = self.cells[name]._channel.clock
        if clock is None:
            clock = Clock()
            clock.wall = wall()
        return clock

    def __iter__(self) -> Iterator[str]:
        return iter(self.cells)
