"""The daemon: takes up configurations, owns the driver processes, and tells clients of both.

Control plane only: it opens, closes, names, supervises and stops. Readings and commands pass it by.

Concurrency: everything runs in the one loop; nothing blocks in it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import partial

from sioms.notify import ServiceManager

from . import suspended
from .alarm_keeper import AlarmKeeper
from .cell import Cell
from .clients import Clients
from .devices import State
from .door import Door
from .fork_server_process import ForkServerProcess
from .listening import Listening
from .loading import Loader, Plan, mistake
from .log import Log
from .loop import Loop
from .needs import this_machine, told
from .processes import Processes
from .realtime import LOOK_S, Budget, make_ordinary, realtime_use
from .requests import Requests
from .rights import Rights
from .shared import Shared
from .stop_record import StopRecord
from .stops import Stops

ALIVE_S = 0.02


class Server:
    """The workcell's daemon.

    Args:
        loop: the loop it lives in.
        listening: where clients connect.
        config_path: where the configuration is read from, again at every reload.
        log: its log.
        record: what has been stopped before it, and is so still.
        process: the fork server for the first configuration, already started; None: start one.
    """

    def __init__(
        self, loop: Loop, listening: Listening, config_path: str, log: Log,
        record: StopRecord, process: ForkServerProcess | None = None,
    ) -> None:  # fmt: skip
        self.cell = Cell(loop, log, Shared(listening.path, record))
        log.note = self.cell.shared.journal.note
        self.exit_status = 0
        self._address = listening.path
        self._path = config_path
        self._first_process = process
        self._loader: Loader | None = None
        self._asked: list[tuple[Callable[[list[str]], None], Callable[[], bool]]] = []
        self._manager = ServiceManager()
        self._told_ready = False
        self._ending = False
        self._budget = Budget(log)
        self.clients = Clients(self.cell)
        self.stops = Stops(self.cell)
        self.alarms = AlarmKeeper(self.cell, self.stops, record.path + ".alarms")
        self.requests = Requests(self.cell, self.clients, self.stops, self.alarms, self.load, self._starting)
        self.processes = Processes(
            self.cell, self.stops, self.alarms, self.requests.nodes, self.requests.markers, self._maybe_ready, self._end
        )
        self.stops.restore()
        self.door = Door(self.cell, self.clients, listening.sock, self.requests.receive)
        self.door.welcome()
        self._alive()
        self._look_at_budget()
        self._look_at_clients()
        if self._manager.watchdog_ns:
            self._feed_watchdog()

    def load(self, done: Callable[[list[str]], None], begin: Callable[[], bool] = lambda: True) -> None:
        """Read the configuration and take it up, all or nothing, as soon as no other load is under way.

        Args:
            done: called with the errors; with any, everything stays as it was. What a right that was taken away had
                opened has ended then.
            begin: asked when its turn has come, before the file is read: whether it is wanted still.
        """
        if (done, begin) not in self._asked:
            self._asked.append((done, begin))
        if self._loader is None:
            self._load()

    def _load(self) -> None:
        """Load for all who have asked."""
        asked, self._asked = self._asked, []
        turn = [done for done, begin in asked if begin()]
        if not turn or self._ending:
            return
        if self._told_ready:
            self._manager.tell(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

        def loaded(plan: Plan | None, errors: list[str]) -> None:
            self._loader = None
            if plan is not None:
                try:
                    self._take_up(plan)
                except Exception as error:  # no reload may be under way for ever
                    errors = [mistake("take up the configuration", error)]
            for text in errors:
                self.cell.log("error", "configuration", text=text)
            if self._told_ready:
                self._manager.tell("READY=1")
            for done in turn:
                self.requests.nodes.when_ended(partial(done, errors))
            if self._asked:
                self._load()

        process, self._first_process = self._first_process, None
        self._loader = Loader(self.cell.loop, self._path, loaded, self.processes.fork_server_died, process, self._slow)
        self._loader.start()

    def _slow(self, progress: str) -> None:
        """Say that loading takes long, so that neither a person nor the service manager takes it for a hang."""
        self.cell.log("info", "describing takes long", progress=progress)
        if not self._told_ready:
            self._manager.tell("EXTEND_TIMEOUT_USEC=30000000")

    def _starting(self) -> str:
        """Return how far the first configuration has come, '' when it is taken up."""
        if self.cell.config is not None:
            return ""
        return self._loader.progress if self._loader is not None else "it ends"

    def shutdown(self) -> None:
        """End all drivers, then the loop."""
        if self._ending:
            return
        self._ending = True
        self.cell.log("info", "shutdown")
        self._manager.tell("STOPPING=1")
        self.processes.shutdown()

    # --- inside ----------------------------------------------------------------------------------

    def _take_up(self, plan: Plan) -> None:
        """Let a configuration hold in which nothing is wrong: no step of this can be refused."""
        first = self.cell.config is None
        if not first and not self.clients.users.look_again():
            self.cell.log("warning", "groups as before", why="the name service does not answer")
        rights = Rights(plan.config.grants, os.getuid(), self.clients.users)
        for name in rights.unknown:
            self.cell.log("warning", "grant to nobody", who=name, why="not known on this machine, or no answer")
        if self.cell.config is not None:
            then, now = self.cell.config.workcell, plan.config.workcell
            for key in ("socket", "socket_mode", "socket_group"):
                if getattr(then, key) != getattr(now, key):
                    self.cell.log(
                        "warning",
                        "not taken up",
                        key=key,
                        why="it holds from the next start of the daemon on",
                    )
        names, self.cell.names = self.cell.names, plan.names
        self.cell.config, self.cell.watched_inputs = plan.config, plan.watched_inputs
        old = self.processes.adopt(plan)
        self.alarms.look_at_plan(plan)
        self.requests.take_up_rights(rights)
        try:
            why = self.cell.shared.files.entitle(rights.who_may_stop())
        except OSError as error:
            why = f"{error.filename or 'the stop-request file'}: {error.strerror}"
        if why:
            self.cell.log("warning", "stop without the daemon", why=why)
        needed, shortages = told(plan.names, plan.config, this_machine())
        self.cell.log("debug", "processors", needed=needed)
        for shortage in shortages:
            self.cell.log("warning", "does not fit", why=shortage)
        if first and plan.config.workcell.start_stopped:
            self.stops.stop_workcell("started stopped, as configured")
        self.requests.supervision.take_up()
        self.processes.take_up(plan, names)
        self.requests.nodes.tell_use()
        if old is not None:
            old.close()
        self.requests.nodes.retry_opens()
        self._maybe_ready()

    def _maybe_ready(self) -> None:
        if self._told_ready or self.cell.config is None or not all(d.settled for d in self.cell.devices.values()):
            return
        self._told_ready = True
        self._manager.tell("READY=1")
        up = sum(d.state is State.UP for d in self.cell.devices.values())
        self.cell.log(
            "info",
            "ready",
            socket=self._address,
            devices=f"{up}/{len(self.cell.devices)}",
            nodes=len(self.cell.names.nodes),
        )

    def _end(self) -> None:
        self.alarms.close()
        self.cell.loop.running = False

    def _alive(self) -> None:
        now_ns = time.monotonic_ns()
        self.cell.shared.latch.daemon_alive(now_ns)
        self.stops.look()
        self.processes.look(now_ns)
        self.cell.loop.after(ALIVE_S, self._alive)

    def _look_at_budget(self) -> None:
        self.cell.log.tell_suppressed()
        use = realtime_use({device.process or device.name: device.pid for device in self.cell.devices.values()})
        self.requests.nodes.tell_use()  # a driver may not have taken what it was told
        if greedy := self._budget.look(time.monotonic(), use):
            make_ordinary(greedy[1])
        self.cell.loop.after(LOOK_S, self._look_at_budget)

    def _look_at_clients(self) -> None:
        self.requests.nodes.end_suspended()
        self.cell.loop.after(suspended.LOOK_S, self._look_at_clients)

    def _feed_watchdog(self) -> None:
        self._manager.tell("WATCHDOG=1")
        self.cell.loop.at(time.monotonic_ns() + self._manager.watchdog_ns, self._feed_watchdog)
