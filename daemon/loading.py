"""Loading a configuration: parse it, let a fresh fork server describe every device, check all names.

Everything is checked before anything is touched, and all errors of all devices come together.
"""

from __future__ import annotations

import errno
import os
import pwd
import stat
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

from sioms.protocol.flags import NodeClass, Reaction
from sioms.protocol.messages import MalformedMessage, unpack_compressed
from sioms.protocol.records import READ, VALUE
from sioms.protocol.text import printable
from sioms.wording import did_you_mean

from .config import AlarmTable, Config, parse
from .fork_server import DIED, ForkServer
from .fork_server_process import ForkServerProcess
from .lines import with_lines
from .loop import Loop, Timer
from .names import DeviceInfo, NameTable, Node, shared_claims
from .needs import priorities
from .patience import Patience

UNWATCHED = ("changed_ns", "flags", "status")
"""Columns that are no quantity."""
LARGEST = 16 << 20
"""Of a configuration [bytes]."""
LOOK_S = 1.0
"""How often the fork server that describes is looked at [s]."""
TELL_S = 5.0
"""How often it is told that describing takes long [s]."""


def mistake(what: str, error: Exception) -> str:
    """Return the sentence about an error of the daemon itself."""
    trace = "".join(traceback.format_exception(error)[-3:])
    return f"{what}: internal error of the daemon, please report it: {error!r}: {trace}"


class NotDescribed(str):
    """An error that says nothing about the configuration: a driver that should have described its device did not."""


@dataclass(frozen=True, slots=True)
class Plan:
    """A configuration that can be taken up.

    Attributes:
        stop_sources: for each device with emergency-stop inputs [block, channel, bit, active] lists.
        watched_inputs: for each device the blocks with emergency-stop inputs that must be readable, and the node of
            one.
        alarms: for each device with alarms what drivers make a Rule of.
    """

    config: Config
    names: NameTable
    fork_server: ForkServer
    stop_sources: dict[str, list[list[int]]]
    watched_inputs: dict[str, dict[int, str]]
    alarms: dict[str, list[list[Any]]]


class Loader:
    """Loads once and tells the result.

    Args:
        loop: the daemon's loop.
        path: of the configuration.
        done: called with the plan (None when there are errors) and the errors.
        fork_server_died: passed on to the fork server.
        process: for the fork server, already started; None: start one.
        slow: told every few seconds how far it has come, from TELL_S on.
    """

    def __init__(
        self, loop: Loop, path: str, done: Callable[[Plan | None, list[str]], None],
        fork_server_died: Callable[[ForkServer], None], process: ForkServerProcess | None = None,
        slow: Callable[[str], None] = lambda text: None,
    ) -> None:  # fmt: skip
        self._slow = slow
        self._began_s = time.monotonic()
        self._waiting: set[str] = set()
        self._count = 0
        self._loop = loop
        self._path = path
        self._done = partial(_tell, done)
        self._died = fork_server_died
        self._process = process
        self._text = ""
        self._infos: dict[str, DeviceInfo] = {}
        self._errors: list[str] = []
        self._fork_server: ForkServer | None = None
        self._timer: Timer | None = None
        self._ended = False

    def start(self) -> None:
        """Begin; the rest happens in the loop."""
        self._guarded(self._start)

    def _start(self) -> None:
        try:
            self._text = read_config(self._path)
        except (OSError, UnicodeDecodeError) as error:
            why = error.strerror if isinstance(error, OSError) else str(error)
            self._end(None, [f"read configuration {self._path}: {str(why).lower()}"])
            return
        config, self._errors = parse(self._text, os.path.dirname(os.path.abspath(self._path)))
        if config is None or not config.devices:
            self._end(None, self._errors)
            return
        self._config = config
        self._waiting = set(config.devices)
        self._count = len(self._waiting)
        self._fork_server = fork_server = ForkServer(self._loop, self._died, self._process)
        self._patience = Patience(fork_server.pid)
        self._patience.renew(time.monotonic())
        self._told_s = self._began_s
        self._timer = self._loop.after(LOOK_S, self._look)
        for name, device in config.devices.items():
            fork_server.describe(
                name, device.common.driver, device.settings, config.folder,
                partial(self._described, name),
            )  # fmt: skip

    def _guarded(self, step: Callable[[], None]) -> None:
        """Take a step; whatever fails in it, the load comes to an end."""
        try:
            step()
        except Exception as error:
            if self._ended:
                raise
            self._end(None, [NotDescribed(mistake("load the configuration", error))])

    def _end(self, plan: Plan | None, errors: list[str]) -> None:
        """Tell the result, once; without a plan nothing is left of the attempt."""
        if self._ended:
            return
        self._ended = True
        self._waiting = set()
        if self._timer is not None:
            self._timer.cancel()
        if plan is None:
            if self._fork_server is not None:
                self._fork_server.close()
            with suppress(Exception):  # better an error without its line than none
                with_lines(self._text, errors)
        self._done(plan, errors)

    def _described(self, name: str, value: Any, errno_: int, text: str, _fds: list[int]) -> None:
        if name not in self._waiting:
            return
        self._waiting.discard(name)
        self._patience.renew(time.monotonic())
        if errno_ == DIED:
            self._errors.append(
                NotDescribed(f"describe [device.{name}]: {text}; a driver that is asked before may have ended it")
            )
        elif errno_:
            self._errors.append(f"[device.{name}]: {text}")
        else:
            try:
                self._take(name, *unpack_compressed(value))
            except (MalformedMessage, ValueError, TypeError, LookupError) as error:
                # A fork server of another version: the software was changed under the running daemon.
                self._errors.append(f"[device.{name}]: its description is not understood ({error}); restart the daemon")
        if not self._waiting:
            self._guarded(self._finish)

    def _take(self, name: str, errors: list[str], packed: list[Any] | None) -> None:
        self._errors += [f"[device.{name}]{error}" for error in errors]
        if packed is not None:
            driver = self._config.devices[name].common.driver
            self._infos[name] = DeviceInfo.unpack(name, driver, packed)

    @property
    def progress(self) -> str:
        """How far it has come, in words."""
        done, passed_s = self._count - len(self._waiting), time.monotonic() - self._began_s
        return f"{done} of {self._count} devices described after {passed_s:.1f} s"

    def _look(self) -> None:
        now_s = time.monotonic()
        if why := self._patience.stuck(now_s):
            self._errors += [
                NotDescribed(
                    f"describe [device.{name}]: its driver does not finish: {why}; "
                    "this says nothing about the configuration"
                )
                for name in [n for n in self._config.devices if n in self._waiting][:1]
            ]
            self._guarded(self._finish)
            return
        if now_s - self._told_s > TELL_S:
            self._told_s = now_s
            self._slow(self.progress)
        self._timer = self._loop.after(LOOK_S, self._look)

    def _finish(self) -> None:
        # Names of devices that failed would only be missed again as targets of aliases.
        names = NameTable({n: self._infos[n] for n in self._config.devices if n in self._infos}, self._config.nodes)
        self._errors += _unknown_users(self._config) + shared_claims(names.devices.values())
        self._errors += _not_together(names, self._config)
        sources, alarms = self._stop_sources(names), self._alarms(names)
        if not self._errors:
            self._errors += names.errors
        if self._errors or self._fork_server is None:
            self._end(None, self._errors)
            return
        watched: dict[str, dict[int, str]] = {}
        for source in self._config.stop_sources:
            if source.on_loss == "stop":
                node = names.nodes[source.node]
                watched.setdefault(node.device, {}).setdefault(node.block, source.node)
        self._end(Plan(self._config, names, self._fork_server, sources, watched, alarms), [])

    def _stop_sources(self, names: NameTable) -> dict[str, list[list[int]]]:
        found: dict[str, list[list[int]]] = {}
        for number, source in enumerate(self._config.stop_sources, 1):
            node = names.nodes.get(source.node)
            if node is None or names.block(node).node_class.name != "BINARY" or len(node.channels) != 1:
                names.errors.append(
                    f"[[emergency_stop]] number {number}: node = {source.node}; want the name of one binary input"
                )
                continue
            found.setdefault(node.device, []).append(
                [node.block, node.channels[0], max(node.bit, 0), int(source.active)]
            )
        return found

    def _alarms(self, names: NameTable) -> dict[str, list[list[Any]]]:
        found: dict[str, dict[tuple[object, ...], list[Any]]] = {}
        for number, alarm in enumerate(self._config.alarms, 1):
            node = names.nodes.get(alarm.node)
            why = why_no_alarm(alarm, node, names)
            if why or node is None:
                names.errors.append(f"[[alarm]] number {number}: {why}")
                continue
            column = alarm.column or VALUE[names.block(node).node_class]
            for channel in node.channels:
                rule = [
                    node.block, channel, node.bit, column, *alarm.limits(), *alarm.reactions(), alarm.node,
                    list(node.channels),
                ]  # fmt: skip
                found.setdefault(node.device, {})[node.block, channel, node.bit, column] = rule
        return {device: list(rules.values()) for device, rules in found.items()}


def why_no_alarm(alarm: AlarmTable, node: Node | None, names: NameTable) -> str:
    """Return what is wrong with an alarm on a node, '' when nothing is."""
    if node is None:
        return f"node = {alarm.node}, which does not exist{did_you_mean(alarm.node, names.nodes)}"
    block = names.block(node)
    columns, cls = READ[block.node_class], block.node_class.name.lower()
    watched = [name for name in columns if name not in UNWATCHED]
    if alarm.column and alarm.column not in watched:
        return f"column = {alarm.column}; want one of the {cls} node {alarm.node}: {', '.join(watched)}"
    is_bit = block.node_class is NodeClass.BINARY and all(
        node.bit >= 0 or block.channels[channel].width <= 1 for channel in node.channels
    )
    if alarm.state is not None and not is_bit:
        return f"state = {alarm.state}; {alarm.node} is not a binary node of single bits; want limits, or one bit"
    if is_bit and alarm.state is None and alarm.column in ("", "data"):
        return f"{alarm.node} is a binary node of single bits; want state = 0 or 1 in the place of limits"
    device = names.devices[node.device].blocks
    for key, reaction in zip(("on_minor", "on_major", "on_invalid"), alarm.reactions(), strict=True):
        stops_none = {
            Reaction.STOP_NODE: not block.writable,
            Reaction.STOP_DEVICE: not any(each.writable for each in device),
        }.get(Reaction(reaction), False)
        if stops_none:
            what = alarm.node if reaction == Reaction.STOP_NODE else f"device {node.device}"
            return f"{key} = {Reaction(reaction).name.lower()}; {what} has no outputs to stop: want stop_workcell"
    return ""


def read_config(path: str) -> str:
    """Return the text of a configuration.

    Raises:
        OSError: it cannot be read; EINVAL, it is not a file, or one of more than LARGEST bytes.
        UnicodeDecodeError: it is no UTF-8.
    """
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe would hold up the daemon
    with open(fd, "rb") as file:
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file")
        data = file.read(LARGEST + 1)
    if len(data) > LARGEST:
        raise OSError(errno.EFBIG, f"it has more than {LARGEST >> 20} MiB")
    return data.decode()


def _unknown_users(config: Config) -> list[str]:
    """Return an error for each device whose driver shall run as somebody who does not exist."""
    errors = []
    for name, device in config.devices.items():
        try:
            pwd.getpwnam(device.common.user or "root")
        except KeyError:
            errors.append(f"[device.{name}]: user = {device.common.user}: no such user; create it or name another")
    return errors


def _not_together(names: NameTable, config: Config) -> Iterator[str]:
    """Tell the devices that cannot share the process that they shall, for a line of their own or as another's."""
    firsts: dict[str, tuple[str, dict[str, object]]] = {}
    of_all = priorities(names, config)
    for name, info in names.devices.items():
        common = config.devices[name].common
        if not common.process:
            continue
        if info.kind in ("line", "stream"):
            yield (
                f"[device.{name}]: process = {common.process}: its driver has a line; want a process of its own, or a "
                "driver without one, as those of simulated devices"
            )
        wanted: dict[str, object] = {"user": common.user or "none", "realtime_priority": of_all[name]}
        first, there = firsts.setdefault(common.process, (name, wanted))
        for key in wanted:
            if wanted[key] != there[key]:
                yield (
                    f"[device.{name}]: {key} = {wanted[key]} in process {common.process}, where that of device {first} "
                    f"is {there[key]}; want the same"
                )


def _tell(done: Callable[[Plan | None, list[str]], None], plan: Plan | None, errors: list[str]) -> None:
    """Tell the errors, whatever characters the configuration has put into them."""
    done(plan, [error if error.isprintable() else printable(error, 2000) for error in errors])
