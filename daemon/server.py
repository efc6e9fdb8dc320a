"""The daemon: takes up configurations, owns the driver processes, and tells clients of both.

Control plane only: it opens, closes, names, supervises and stops. Readings and commands pass it by.

Concurrency: everything runs in the one loop; nothing blocks in it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from sioms.notify import ServiceManager
from sioms.protocol import driver_verbs
from sioms.protocol.flags import PageState
from sioms.protocol.journal import Note
from sioms.protocol.stopjournal import NODE, PID, node_entry, parts_of, workcell_entry
from sioms.protocol.verbs import Message

from . import suspended
from .alarm_keeper import AlarmKeeper
from .clients import Clients
from .config import Config
from .devices import DriverProcess, State
from .fork_server import ForkServer
from .fork_server_process import ForkServerProcess
from .holds import Holds
from .listening import Listening
from .loading import Loader, Plan, mistake
from .log import Log
from .loop import Loop
from .names import NameTable, Node, part_name
from .needs import priorities, this_machine, told
from .realtime import LOOK_S, Budget, make_ordinary, realtime_use
from .rights import Rights
from .shared import Shared
from .stop_record import StopRecord

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
        self.loop = loop
        self.log = log
        self.shared = Shared(listening.path, record)
        log.note = self.shared.journal.note
        self.names = NameTable({}, {})
        self.devices: dict[str, DriverProcess] = {}
        self.config: Config | None = None
        self.clients = Clients(self, listening.sock, listening.path)
        self.exit_status = 0
        self._path = config_path
        self._fork_server: ForkServer | None = None
        self._first_process = process
        self._options: dict[str, dict[str, Any]] = {}
        self._watched_inputs: dict[str, dict[int, str]] = {}
        self._holds = Holds()
        self._leaving: dict[str, DriverProcess] = {}
        self._loader: Loader | None = None
        self._asked: list[tuple[Callable[[list[str]], None], Callable[[], bool]]] = []
        self._manager = ServiceManager()
        self._told_ready = False
        self._ending = False
        self._request_seen = self.shared.request.mark
        self._budget = Budget(log)
        self.alarms = AlarmKeeper(self, record.path + ".alarms")
        self._restore_stops()
        self.clients.welcome()
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
                self.log("error", "configuration", text=text)
            if self._told_ready:
                self._manager.tell("READY=1")
            for done in turn:
                self.clients.nodes.when_ended(partial(done, errors))
            if self._asked:
                self._load()

        process, self._first_process = self._first_process, None
        self._loader = Loader(self.loop, self._path, loaded, self._fork_server_died, process, self._slow)
        self._loader.start()

    def _slow(self, progress: str) -> None:
        """Say that loading takes long, so that neither a person nor the service manager takes it for a hang."""
        self.log("info", "describing takes long", progress=progress)
        if not self._told_ready:
            self._manager.tell("EXTEND_TIMEOUT_USEC=30000000")

    @property
    def starting(self) -> str:
        """How far the first configuration has come, '' when it is taken up."""
        if self.config is not None:
            return ""
        return self._loader.progress if self._loader is not None else "it ends"

    def shutdown(self) -> None:
        """End all drivers, then the loop."""
        if self._ending:
            return
        self._ending = True
        self.log("info", "shutdown")
        self._manager.tell("STOPPING=1")
        for device in list(self.devices.values()):
            self._retire(device)
        self._maybe_end()

    # --- stops -----------------------------------------------------------------------------------

    def _restore_stops(self) -> None:
        """Be stopped from the beginning when it was so at the end."""
        stopped = self.shared.record.state
        if stopped.workcell:
            since = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(stopped.since_s))
            self.shared.latch.stop(time.monotonic_ns(), f"{stopped.workcell} (since {since})")
            self.log("warning", "still stopped", source=self.shared.latch.source)
        for node, source in stopped.nodes():
            self.log("warning", "still stopped", node=node, source=source)
        if self.shared.files.unheard:
            self.stop_workcell(self.shared.files.unheard)

    def stop_workcell(self, source: str) -> None:
        """Latch the emergency stop, wake every driver, and keep it."""
        latch = self.shared.latch
        known = not latch.stop(time.monotonic_ns(), source) and not (
            latch.source == self.shared.request.source != source
        )
        if not known:
            self.log("warning", "emergency stop", source=source)
            latch.name_source(source)  # drivers see the request page before the message that says who
        for device in self.devices.values():
            device.tell(driver_verbs.StopChanged())
        self.shared.record.look()
        if not known or not self.shared.record.state.workcell:
            self._note(workcell_entry(source, stop=True, named=True, latched_ns=latch.stopped_ns))

    def hear_request(self) -> str:
        """Obey the stop-request file; return who has asked for a stop that nobody had heard yet, '' for nobody.

        A client that could not reach us has asked the drivers directly; they have acted already, as a rule.
        """
        request = self.shared.request
        if (mark := request.mark) == self._request_seen:
            return ""
        self._request_seen = mark
        source, heard = request.source, request.taken(mark[0])
        self.stop_workcell(source)
        request.take(mark)
        return "" if heard else source

    def reset_workcell(self, who: str) -> None:
        """Clear the latch and give devices in fault another try; nothing moves by itself."""
        latched_ns = self.shared.latch.stopped_ns
        self._note(workcell_entry(who, stop=False, latched_ns=latched_ns))  # first: a later stop is noted after it
        self.shared.latch.reset(self._request_seen)  # what has been asked for since then has not been heard
        self.log("warning", "reset", by=who)
        for device in self.devices.values():
            device.trouble = ""
            device.tell(driver_verbs.StopChanged())
            device.reset()
        for device in self.devices.values():
            self._look_at_stop_inputs(device)  # as one that is still pressed, it stops the workcell again

    def stop_node(self, node: Node, source: str) -> None:
        """Stop a node and keep that; one whose driver is not there starts stopped.

        Raises:
            OSError: EIO, its driver takes no messages: it will be stopped when it is started again.
        """
        try:
            self._order(node, driver_verbs.NodeStop, source)
        finally:
            self._note(self._node_entry(node, source, stop=True))
            self.log("warning", "emergency stop", node=node.name, source=source)

    def reset_node(self, node: Node, who: str) -> None:
        """Clear the stop and the faults of a node.

        The reset is noted first: a stop that its driver takes after the reset, and notes by itself, is noted after it.

        Raises:
            OSError: EIO, its driver takes no messages.
        """
        record = self.shared.record
        record.look()
        before = [entry for entry in record.state.entries() if entry.get("device") == node.device]
        self._note(self._node_entry(node, who, stop=False))
        try:
            self._order(node, driver_verbs.NodeReset, who)
        except OSError:
            for entry in before:
                self._note(entry)
            raise
        self.log("warning", "reset", node=node.name, by=who)

    def _order(self, node: Node, order: type[driver_verbs.NodeStop | driver_verbs.NodeReset], source: str) -> None:
        device = self.devices.get(node.device) or self._leaving.get(node.device)
        if device is not None and device.is_there:
            device.send(order(node.block, node.channels, node.bit, source, self.shared.latch.resets))
            self.shared.latch.ordered()

    def _node_entry(self, node: Node, source: str, *, stop: bool) -> dict[str, Any]:
        block = self.names.devices[node.device].blocks[node.block]
        parts = [
            part for c in node.channels for part in parts_of(c, node.bit, block.channels[c].width)
        ]  # fmt: skip
        return node_entry(node.name, node.device, block.name, parts, source, stop=stop)

    def _note(self, entry: dict[str, Any]) -> None:
        try:
            self.shared.record.note(entry)
        except OSError as error:
            self.log("error", "not kept", what=str(entry), path=self.shared.record.path, why=error.strerror)

    def stopped_of(self, device: str) -> list[list[Any]]:
        """Return what of a device is stopped and must be so from its driver's start."""
        record = self.shared.record
        record.look()
        record.by_drivers = [entry for entry in record.by_drivers if entry.get("device") != device]
        return self.shared.record.state.of_device(device)

    def _pass_on_stops(self) -> None:
        """Send on the stops of nodes that drivers have acknowledged which are not ours, as of a daemon before us.

        Only stops: what such a driver resets, it resets for itself.
        """
        record = self.shared.record
        entries, record.by_drivers = record.by_drivers, []
        for entry in entries:
            device = self.devices.get(str(entry.get("device")))
            if device is None or not device.is_there or device.pid == entry[PID]:
                continue
            channels_of: dict[tuple[int, int], list[int]] = {}
            for _, name, channel, bit in record.state.still(entry):
                number = next((i for i, block in enumerate(device.info.blocks) if block.name == name), -1)
                if number >= 0 and channel < len(channels := device.info.blocks[number].channels):
                    channels_of.setdefault((number, bit if channels[channel].width else -1), []).append(channel)
            for (number, bit), stopped in channels_of.items():
                device.tell(driver_verbs.NodeStop(number, stopped, bit, str(entry["by"]), self.shared.latch.resets))
                self.shared.latch.ordered()
            self.log("warning", "emergency stop", node=entry[NODE], source=entry["by"], heard_by=entry[PID])

    # --- what devices tell -----------------------------------------------------------------------

    def device_up(self, device: DriverProcess) -> None:
        """Give the new process the pages it reads, and its page to those that read it."""
        self.alarms.of_device(device.name, "driver", "")
        for other in self.devices.values():
            for name in other.info.inputs:
                if other is device or self.names.nodes[name].device == device.name:
                    self._send_input(other, name)
        self.look_at_use()
        self._look_at_holds()
        self.clients.nodes.retry_opens()
        self._maybe_ready()

    def _look_at_holds(self) -> None:
        self._holds.look(self.devices, self.names, self.clients.nodes)

    def look_at_use(self) -> None:
        """Tell drivers whether somebody reads them through other devices, directly or not.

        Somebody is who has a node open, and the workcell's stop where an input of a device is to stop it.
        """
        used: set[str] = set()
        readers = [name for name in self.devices if self.clients.nodes.is_open(name) or self._watched_inputs.get(name)]
        while readers:
            reader = self.devices.get(readers.pop())
            for name in reader.info.inputs if reader is not None else ():
                source = self.names.nodes.get(name)
                if source is not None and source.device not in used:
                    used.add(source.device)
                    readers.append(source.device)
        for device in self.devices.values():
            device.tell_use(device.name in used)

    def device_gone(self, device: DriverProcess, reason: str) -> None:
        """Void the handles of a process that is no more, and stop what is tied to it."""
        device.trouble = ""
        self._holds.device_gone(device, self.clients.nodes)
        self.clients.nodes.device_gone(device, reason)
        self.alarms.gone(device, reason)
        if device.state is not State.DOWN and device.device.common.on_loss == "stop":
            self.stop_workcell(f"device {device.name} lost: {reason}")
        if device.state is not State.DOWN:
            self._look_at_stop_inputs(device)
        self._maybe_ready()

    def device_hung(self, device: DriverProcess, reason: str) -> None:
        """Report a missed lease, and stop what is tied to the device."""
        self.log("warning", "device late", device=device.name, reason=reason)
        self.alarms.hung(device, reason)
        if device.device.common.on_loss == "stop":
            self.stop_workcell(f"device {device.name}: {reason}")
        self._look_at_stop_inputs(device)

    def device_ticks(self, device: DriverProcess) -> None:
        """Note that a driver that had missed its lease ticks again."""
        self.alarms.of_device(device.name, "driver", "")

    def _look_at_stop_inputs(self, device: DriverProcess) -> None:
        """Stop the workcell when an input of a device that is to stop it cannot be read: it may be pressed."""
        for block, node in self._watched_inputs.get(device.name, {}).items():
            if why := device.why_unreadable(block):
                self.stop_workcell(f"input {node} stops the workcell, and it cannot be read: {why}")
                return

    def device_message(self, device: DriverProcess, message: Message) -> None:
        """Take a notice of a driver."""
        match message:
            case driver_verbs.Detached(handle):
                self.clients.nodes.detached(device, handle)
            case driver_verbs.MarkerSignalled(number):
                stamp_ns = self.shared.markers.stamp_ns(number)
                self.shared.journal.note(Note.MARKER, stamp_ns, device.name, number)
                self.clients.markers.signalled()
            case driver_verbs.Stopped(source):
                self.log("warning", "emergency stop", source=source, device=device.name)
                for other in self.devices.values():
                    other.tell(driver_verbs.StopChanged())
            case driver_verbs.LinkChanged(number, reason):
                state = PageState(number)
                good = state in (PageState.GOOD, PageState.STARTING)
                self.log(
                    "info" if good else "error",
                    "link",
                    device=device.name,
                    state=state.name.lower(),
                    reason=reason,
                )
                if state is not PageState.STARTING:
                    self.alarms.of_device(device.name, "link", "" if good else reason or state.name.lower())
                if not good and device.device.common.on_loss == "stop":
                    self.stop_workcell(f"device {device.name}: {reason}")
                if not good:
                    self._look_at_stop_inputs(device)
            case driver_verbs.AlarmChanged(block, channel, bit, what, severity, text):
                node = part_name(device.info, block, channel, bit)
                self.alarms.take(node, device.name, what, severity, text)
            case driver_verbs.HeldSilent(name, why):
                self._holds.silent(device, name, why, self)
            case driver_verbs.LogLine(level, text):
                if text.startswith("fault of "):
                    device.trouble = text
                self.log(level, "driver", device=device.name, text=text)
            case _:
                raise NotImplementedError(f"{type(message).__name__} is not served")

    # --- inside ----------------------------------------------------------------------------------

    def _take_up(self, plan: Plan) -> None:
        """Let a configuration hold in which nothing is wrong: no step of this can be refused."""
        first = self.config is None
        if not first and not self.clients.users.look_again():
            self.log("warning", "groups as before", why="the name service does not answer")
        rights = Rights(plan.config.grants, os.getuid(), self.clients.users)
        for name in rights.unknown:
            self.log("warning", "grant to nobody", who=name, why="not known on this machine, or no answer")
        if self.config is not None:
            then, now = self.config.workcell, plan.config.workcell
            for key in ("socket", "socket_mode", "socket_group"):
                if getattr(then, key) != getattr(now, key):
                    self.log(
                        "warning",
                        "not taken up",
                        key=key,
                        why="it holds from the next start of the daemon on",
                    )
        names, old = self.names, self._fork_server
        self.config, self.names, self._fork_server = plan.config, plan.names, plan.fork_server
        self._watched_inputs = plan.watched_inputs
        of_all = priorities(plan.names, plan.config)
        self._options = {name: self._options_of(name, plan, of_all[name]) for name in plan.config.devices}
        self.alarms.look_at_plan(plan)
        self.clients.take_up_rights(rights)
        try:
            why = self.shared.files.entitle(rights.who_may_stop())
        except OSError as error:
            why = f"{error.filename or 'the stop-request file'}: {error.strerror}"
        if why:
            self.log("warning", "stop without the daemon", why=why)
        needed, shortages = told(plan.names, plan.config, this_machine())
        self.log("debug", "processors", needed=needed)
        for shortage in shortages:
            self.log("warning", "does not fit", why=shortage)
        if first and plan.config.workcell.start_stopped:
            self.stop_workcell("started stopped, as configured")
        self.clients.supervision.take_up()
        for name, device in list(self.devices.items()):
            wanted = plan.config.devices.get(name)
            same = wanted == device.device and plan.names.devices[name].facts() == device.info.facts()
            if not same or {**self._options[name], "phase": 0} != {**device.options, "phase": 0}:
                self.log("info", "device ends", device=name, why="removed" if wanted is None else "changed")
                self._retire(device)
        for name in plan.config.devices:
            self._start(name)
        for device in self.devices.values():
            for name in device.info.inputs:
                if names.nodes.get(name) != self.names.nodes[name]:
                    self._send_input(device, name)  # the name shows something else now
        self.look_at_use()
        if old is not None:
            old.close()
        self.clients.nodes.retry_opens()
        self._maybe_ready()

    def _options_of(self, name: str, plan: Plan, priority: int) -> dict[str, Any]:
        """Return what a driver is told beside its own settings."""
        return {
            "stop_sources": plan.stop_sources.get(name, []),
            "alarms": plan.alarms.get(name, []),
            "daemon_lease_s": plan.config.workcell.daemon_lease_s,
            "folder": plan.config.folder,
            "state_folder": plan.config.state_folder(os.environ),
            "realtime_priority": priority,
            # Golden-ratio steps: however many drivers there are, their ticks do not fall together. Those of one process
            # do: they need one wake.
            "phase": (plan.config.processes.index(plan.config.process_of(name)) * 0.6180339887) % 1.0,
        }

    def _start(self, name: str) -> None:
        """Start a configured device that is not there yet; one that is leaving starts when it has left."""
        if self.config is None or self._ending or name in self.devices or name in self._leaving:
            return
        device = DriverProcess(
            self.loop, self._current_fork_server, self.config.devices[name], self.names.devices[name],
            self.shared.fds, self, self.log, self._options[name],
        )  # fmt: skip
        self.devices[name] = device
        device.start()

    def is_replaced(self, name: str) -> bool:
        """Tell whether a device is leaving and starts again, as configured now, when it has left."""
        return name in self._leaving and self.config is not None and name in self.config.devices

    def _retire(self, device: DriverProcess) -> None:
        del self.devices[device.name]
        self._leaving[device.name] = device
        device.shutdown(lambda: self._left(device))

    def _left(self, device: DriverProcess) -> None:
        os.close(device.journal_fd)
        del self._leaving[device.name]
        if self.config is not None and device.name in self.config.devices:
            self._start(device.name)
        self._maybe_end()

    def _current_fork_server(self) -> ForkServer:
        if self._fork_server is None:
            self._fork_server = ForkServer(self.loop, self._fork_server_died)
        return self._fork_server

    def _fork_server_died(self, fork_server: ForkServer) -> None:
        if fork_server is self._fork_server and not self._ending:
            self.log("error", "fork server died")
            self._fork_server = None

    def _send_input(self, reader: DriverProcess, name: str) -> None:
        node = self.names.nodes[name]
        source = self.devices.get(node.device)
        if source is None or reader.state is not State.UP or source.state is not State.UP:
            return
        try:
            reader.send(driver_verbs.Input(name, node.channels, node.bit), [source.page_fds[node.block]])
        except OSError as error:
            self.log("warning", "input lost", device=reader.name, node=name, why=error.strerror)

    def _maybe_ready(self) -> None:
        if self._told_ready or self.config is None or not all(d.settled for d in self.devices.values()):
            return
        self._told_ready = True
        self._manager.tell("READY=1")
        up = sum(d.state is State.UP for d in self.devices.values())
        self.log(
            "info",
            "ready",
            socket=self.clients.address,
            devices=f"{up}/{len(self.devices)}",
            nodes=len(self.names.nodes),
        )

    def _maybe_end(self) -> None:
        if self._ending and not self._leaving:
            if self._fork_server is not None:
                self._fork_server.close()
            self.alarms.close()
            self.loop.running = False

    def _alive(self) -> None:
        now = time.monotonic_ns()
        self.shared.latch.daemon_alive(now)
        self.hear_request()
        self.shared.record.look()
        if (source := self.shared.record.state.workcell) and not self.shared.latch.stopped_ns:
            self.stop_workcell(source)  # a driver could not keep a stop
        self._pass_on_stops()
        self._look_at_holds()
        for device in list(self.devices.values()):
            device.check(now)
        if self._fork_server is not None and (why := self._fork_server.check(now / 1e9)):
            self.log("error", "fork server killed", why=why)
        self.loop.after(ALIVE_S, self._alive)

    def _look_at_budget(self) -> None:
        self.log.tell_suppressed()
        use = realtime_use({device.process or device.name: device.pid for device in self.devices.values()})
        self.look_at_use()  # a driver may not have taken what it was told
        if greedy := self._budget.look(time.monotonic(), use):
            make_ordinary(greedy[1])
        self.loop.after(LOOK_S, self._look_at_budget)

    def _look_at_clients(self) -> None:
        self.clients.nodes.end_suspended()
        self.loop.after(suspended.LOOK_S, self._look_at_clients)

    def _feed_watchdog(self) -> None:
        self._manager.tell("WATCHDOG=1")
        self.loop.at(time.monotonic_ns() + self._manager.watchdog_ns, self._feed_watchdog)
