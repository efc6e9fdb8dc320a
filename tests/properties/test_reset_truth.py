"""A reset that is acknowledged has cleared all that there was, and one that is refused nothing, whatever came before it
was sent, while it was under way, and between its answer and the driver that carries it out.

The real daemon and a real driver (``ownership_cell``) take every such order of events; what must come out is told by
the times of the events alone.
"""

from __future__ import annotations

import itertools
import os
import random
from collections.abc import Iterator, Sequence

import pytest
from ownership_cell import Cell, cells
from ownership_explorer import begin
from ownership_fakes import CLOCK, NAMES

from sioms.protocol.flags import Request
from sioms.protocol.messages import ClientVerb, HandleVerb, decode, encode
from sioms.timestamps import Timestamps

OWNER, RESETTER, STOPPER = 0, 1, 2
AXIS = 0
EVENTS = ("nothing", "fault", "jam", "stop of the node", "stop on a handle", "stop of the workcell")
"""What may happen at any time; a jam is a fault that nobody can have seen yet."""
WAYS = ("by name", "of the workcell", "on a handle")
STEPS = 4000
NEVER_NS = 1 << 62
MORE = int(os.environ.get("SIOMS_EXPLORE_DEPTH", "1")) > 1


class Cut:
    """A cell whose client 0 owns the axis, one reset under way at a time, and what must be standing: since when."""

    def __init__(self, cell: Cell, sent: list[int]) -> None:
        self.cell, self._sent = cell, sent
        for action in [*begin("nobody owns anything"), ("open", OWNER, AXIS), ("hear", AXIS), ("listen", AXIS)]:
            cell.take(action)
        self.standing: dict[str, int] = {}
        self.under_way: tuple[str, int] | None = None

    def happen(self, event: str) -> None:
        """Let something happen at once."""
        runtime = self.cell._process(AXIS).runtime
        bank = runtime.blocks[0].bank  # type: ignore[attr-defined]
        CLOCK.now_ns += 1000
        match event:
            case "fault" | "jam":
                if not bank.is_in_fault(0):  # a further one does not count
                    bank.fault([0], "it jams", CLOCK())
                    self.standing["fault"] = NEVER_NS
                if event == "fault":
                    self.show()
            case "stop of the node":
                assert self.cell.take(("stop_node", STOPPER, AXIS)) == "done"
                self.standing["node"] = CLOCK()
            case "stop on a handle":  # of another client than who resets on one
                runtime.heed()
                runtime.stops.stop_node(runtime.blocks[0], [0], -1, "eva", by=77)
                handle = next(iter(runtime.clients.handles.values()))
                runtime.stops.note_node(handle, "eva", stop=True)
                self.standing["node"] = CLOCK()
            case "stop of the workcell":
                assert self.cell.take(("stop", STOPPER)) == "done"
                self.standing["workcell"] = CLOCK()
        self._look()

    def _look(self) -> None:
        """Note since when somebody may have seen a fault."""
        runtime = self.cell._process(AXIS).runtime
        if self.standing.get("fault") == NEVER_NS and not runtime.blocks[0].bank._queue._new_faults:  # type: ignore[attr-defined]
            self.standing["fault"] = CLOCK()

    def show(self) -> None:
        """Publish, as a tick does."""
        runtime = self.cell._process(AXIS).runtime
        runtime.publish(runtime.blocks[0], CLOCK())
        self._look()

    def send(self, way: str) -> None:
        """Send a reset, which lies there."""
        CLOCK.now_ns += 1000
        client = self.cell.clients[OWNER if way == "on a handle" else RESETTER]
        if way == "on a handle":
            client.last += 1
            client.handles[AXIS].send(encode(HandleVerb.IOCTL, client.last, int(Request.RESET), None, None))
        else:
            client.ask(ClientVerb.RESET, "" if way == "of the workcell" else NAMES[AXIS])
        self.under_way = (way, CLOCK())

    def serve(self) -> None:
        """Let who is asked come to it, and compare the answer."""
        assert self.under_way is not None
        (way, sent_ns), self.under_way = self.under_way, None
        CLOCK.now_ns += 1000
        client = self.cell.clients[OWNER if way == "on a handle" else RESETTER]
        self._sent[:] = [sent_ns]
        if way == "on a handle":
            runtime = self.cell._process(AXIS).runtime
            runtime.clients._readable(next(iter(runtime.clients.handles.values())))
            answer = ""
            while not answer:
                message = decode(client.handles[AXIS].recv(1 << 16))
                if message[:2] == [0, client.last]:
                    answer = "refused" if message[2] else "done"
        else:
            self.cell._serve_session(RESETTER)
            answer = client.take()[client.last]
        self._sent.clear()
        self._look()
        known = {what for what, at in self.standing.items() if at < NEVER_NS}
        unseen = {what for what in known if self.standing[what] > sent_ns}
        barred = way != "of the workcell" and "workcell" in self.standing
        assert answer == ("refused" if unseen or barred else "done"), (way, self.standing, sent_ns)
        if answer == "done":
            self.standing = {what: at for what, at in self.standing.items() if what not in known}

    def settle(self) -> None:
        """Let all hear all, and compare what stands."""
        for handle in self.cell._process(AXIS).runtime.clients.handles.values():
            handle.heard_ns = CLOCK()
        for _ in range(2):
            self.cell.take(("tick", AXIS))
            self.cell.take(("listen", AXIS))
            self.cell.take(("beat",))
            self._look()
        bank = self.cell._process(AXIS).runtime.blocks[0].bank  # type: ignore[attr-defined]
        assert bank.is_in_fault(0) == ("fault" in self.standing), self.standing
        assert bank.is_stopped(0) == bool({"node", "workcell"} & set(self.standing)), self.standing
        self.cell.record.look()  # type: ignore[union-attr]
        state = self.cell.record.state  # type: ignore[union-attr]
        assert bool(state.workcell) == ("workcell" in self.standing)
        assert [name for name, _ in state.nodes()] == [NAMES[AXIS]] * ("node" in self.standing)

    def clear(self) -> None:
        """Begin anew."""
        for way in ("of the workcell",):
            self.send(way)
            self.serve()
        self.settle()
        assert not self.standing


@pytest.fixture
def cut() -> Iterator[Cut]:
    sent: list[int] = []
    with cells() as make, pytest.MonkeyPatch.context() as patch:  # undone before what the cells have patched is
        patch.setattr(Timestamps, "monotonic_ns", lambda *_: sent[0] if sent else CLOCK())
        yield Cut(make(), sent)


@pytest.mark.parametrize("way", WAYS)
def test_an_answer_to_a_reset_is_true(cut: Cut, way: str) -> None:
    between: Sequence[tuple[str, ...]] = [(event,) for event in EVENTS]
    if MORE:
        between = list(itertools.product(EVENTS, repeat=2))
    for before, while_under_way, after in itertools.product(EVENTS, between, EVENTS):
        try:
            cut.happen(before)
            cut.show()
            cut.send(way)
            for event in while_under_way:
                cut.happen(event)
            cut.serve()
            cut.happen(after)
            cut.settle()
            cut.clear()
        except AssertionError as error:
            raise AssertionError(f"{before}; reset {way}; {while_under_way}; served; {after}: {error}") from None


@pytest.mark.parametrize("seed", [1, 2])
def test_answers_to_resets_are_true_at_random(cut: Cut, seed: int) -> None:
    chance = random.Random(seed)
    for _ in range(STEPS // 4):
        if cut.under_way is not None and chance.random() < 0.4:
            cut.serve()
        elif cut.under_way is None and chance.random() < 0.3:
            cut.send(chance.choice(WAYS))
        else:
            match chance.randrange(4):
                case 0:
                    cut.cell.take((chance.choice(["tick", "listen"]), AXIS))
                    cut._look()
                case 1 if cut.under_way is None:
                    cut.settle()
                case _:
                    cut.happen(chance.choice(EVENTS))
