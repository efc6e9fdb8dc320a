"""``sioms monitor``: a live view of all nodes in a terminal, with the emergency stop on a key.

A thread of its own asks the daemon, so that a daemon that hangs delays neither the picture nor the
stop. Values come out of the shared pages. When standard output is no terminal, or a dumb one, one picture is printed.
"""

from __future__ import annotations

import argparse
import errno
import os
import shutil
import signal
import sys
import termios
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from time import localtime, monotonic_ns, strftime
from typing import Any

from sioms.client.stopping import emergency_stop
from sioms.client.workcell import NodeEntry, Workcell, is_part
from sioms.descriptors import is_readable
from sioms.protocol.flags import READONLY

from . import monitor_jog
from .monitor_events import History
from .monitor_view import Jog, NodeView, Style, Text, View, page, screen

FRAME_S = 0.1
ASK_S = 0.5
MESSAGE_NS = 5_000_000_000
MANY = 1 << 20
"""Lines to scroll that are more than there are: to the end."""
_INK = {
    Style.PLAIN: "", Style.HEAD: "\x1b[1m", Style.DIM: "\x1b[2m", Style.GOOD: "\x1b[32m", Style.WARN: "\x1b[33m",
    Style.ALARM: "\x1b[1;37;41m",
}  # fmt: skip
_PLAIN_INK = {**dict.fromkeys(Style, ""), Style.HEAD: "\x1b[1m", Style.ALARM: "\x1b[1;7m"}
"""Without colours, as $NO_COLOR asks for: what must be seen is bold and reversed."""
_ENTER, _LEAVE = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
_SCROLL = {"\x1b[A": -1, "k": -1, "\x1b[B": 1, "j": 1, "\x1b[5~": -10, "\x1b[6~": 10}


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser("monitor", help="display all nodes live; stop, reset and jog by key")
    parser.add_argument("nodes", metavar="NODE", nargs="*", help="nodes to display (default: all)")


def run(args: argparse.Namespace) -> int:
    """Watch until q is pressed, or print one picture; return the exit status."""
    watch = Watch(args.nodes)
    if args.nodes:
        watch.ask()
        if watch.cell is not None and (unknown := watch.unknown()):
            raise OSError(errno.ENOENT, f"no such node: {', '.join(unknown)}; `sioms list -v` lists all")
    if not _can_paint():
        watch.ask()
        if watch.cell is None:
            raise OSError(watch.lost)
        print("\n".join(page(watch.view(""), max(100, shutil.get_terminal_size((120, 24)).columns))))
        return 0
    thread = threading.Thread(target=watch.go_on, name="ask", daemon=True)
    thread.start()
    with _terminal():
        Monitor(watch).go_on()
    watch.ended.set()
    return 0


def _can_paint() -> bool:
    """Tell whether there is a terminal with keys and a cursor that can be placed."""
    return sys.stdout.isatty() and sys.stdin.isatty() and os.environ.get("TERM") != "dumb"


class Watch:
    """What is known of the workcell.

    Concurrency: ``ask`` runs in one thread and replaces whole values; ``view`` and the keys in another.

    Args:
        only: names of the nodes to show; all when empty.
    """

    def __init__(self, only: list[str]) -> None:
        self.cell: Workcell | None = None
        self.lost = ""
        self.ended = threading.Event()
        self._only = only
        self._status: dict[str, Any] = {}
        self._alarms: list[dict[str, Any]] = []
        self._entries: list[NodeEntry] = []
        self._nodes: dict[str, Any] = {}
        self._why: dict[str, str] = {}
        self._seen: dict[str, tuple[int, int, float | None]] = {}
        self._last: dict[str, tuple[Any, Any, int]] = {}

    def go_on(self) -> None:
        """Ask until told to end."""
        while not self.ended.is_set():
            self.ask()
            self.ended.wait(ASK_S)

    def ask(self) -> None:
        """Ask the daemon for everything that is not in the pages; connect when there is no connection."""
        try:
            cell = self.cell
            if cell is None:
                self._nodes, self._why = {}, {}
                cell = Workcell(name="sioms monitor")
            entries = [e for e in cell.nodes() if not e.name.endswith(READONLY)] if self._only else cell.nodes()
            self._entries = [e for e in entries if (e.name in self._only if self._only else not is_part(e, entries))]
            self._status, self._alarms = cell.status(), cell.alarms()
            self._open(cell)
            self.cell, self.lost = cell, ""
        except OSError as error:
            self.lost = error.strerror or str(error)
            # A daemon that only hangs is kept: the stop goes through a page that needs no answer.
            if error.errno != errno.ETIMEDOUT and self.cell is not None:
                self.cell.close()
                self.cell = None

    def unknown(self) -> list[str]:
        """Return the names that were asked for and that no node has."""
        return [name for name in self._only if name not in {entry.name for entry in self._entries}]

    def _open(self, cell: Workcell) -> None:
        """Open what is not open, or not any more; the daemon's death ends it all."""
        for entry in self._entries:
            if entry.name in self._nodes:
                continue
            try:
                name = entry.name if entry.read_only else entry.name + READONLY
                self._nodes[entry.name] = cell.open(name)
                self._why.pop(entry.name, None)
            except OSError as error:
                self._why[entry.name] = error.strerror or str(error)
        for name in self._nodes.keys() - {entry.name for entry in self._entries}:
            self._nodes.pop(name).close()

    def view(self, message: str, jog: Jog | None = None) -> View:
        """Read all pages and return what is to be shown."""
        now_ns = monotonic_ns()
        nodes = [self._look(entry, now_ns) for entry in list(self._entries)]
        clock = strftime("%H:%M:%S", localtime())
        status, alarms = (self._status, self._alarms) if self.cell else ({}, [])
        return View(status, nodes, self.lost, message, now_ns, clock=clock, jog=jog, alarms=alarms)

    def _look(self, entry: NodeEntry, now_ns: int) -> NodeView:
        node = self._nodes.get(entry.name)
        snapshot = None
        why = self._why.get(entry.name, self.lost)
        if node is not None:
            try:
                snapshot = node.read()
            except OSError as error:
                why = error.strerror or str(error)
                # A driver that was restarted has a new page: open it anew, the next time round.
                self._why[entry.name] = why
                self._nodes.pop(entry.name, None)
        if snapshot is not None and node is not None:
            self._last[entry.name] = (node.info, snapshot, now_ns)
            rate = self._rate(entry.name, snapshot.number, now_ns)
            return NodeView(entry.name, entry.device, node.info, snapshot, why, entry.holder, rate)
        # What it was last stays in sight, marked as old.
        info, old, seen_ns = self._last.get(entry.name, (None, None, now_ns))
        age_s = (now_ns - seen_ns) / 1e9 if old is not None else None
        return NodeView(entry.name, entry.device, info, old, why, entry.holder, None, age_s)

    def _rate(self, name: str, number: int, now_ns: int) -> float | None:
        """Return publications a second, over about a second."""
        number0, then_ns, rate = self._seen.get(name, (number, now_ns, None))
        if number < number0:  # another driver process
            number0, then_ns, rate = number, now_ns, None
        if now_ns - then_ns > 1_000_000_000:
            rate = (number - number0) / (now_ns - then_ns) * 1e9
            number0, then_ns = number, now_ns
        self._seen[name] = (number0, then_ns, rate)
        return rate


class Monitor:
    """The picture and the keys."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self._message = ""
        self._message_ns = 0
        self._scroll = 0
        self._confirming = False
        self._ended = False
        self._shows_history = False
        self._history = History()
        self._jogger = monitor_jog.Jogger()

    def go_on(self) -> None:
        """Show frames and obey keys until q."""
        try:
            self._go_on()
        finally:
            self._jogger.let_go()

    def _go_on(self) -> None:
        while not self._ended:
            size = shutil.get_terminal_size()
            view = self._watch.view(self._message, self._jogger.shown)
            self._history.look(view)
            view = replace(view, events=tuple(self._history.lines), history=self._shows_history)
            lines, self._scroll = screen(view, size.columns, size.lines, self._scroll)
            _paint(lines)
            if is_readable(0, FRAME_S):
                typed = os.read(0, 256).decode("utf-8", "replace")
                if not typed:
                    return
                self._obey(typed)
                self._message_ns = monotonic_ns()
            if said := self._jogger.beat(monotonic_ns()):
                self._tell(said)
            elif monotonic_ns() - self._message_ns > MESSAGE_NS and not self._confirming:
                self._message = ""

    def _obey(self, typed: str) -> None:
        # A stop first, whatever else is in the same burst of keys.
        if " " in typed or "e" in typed:
            self._confirming = False
            self._message = self._stop()
            self._jogger.let_go()
            self._tell(self._message)
        elif (keys := _jog_keys(typed)) and not self._confirming:
            for key in keys:
                self._message = self._jogger.press(key, monotonic_ns())
        elif typed in _SCROLL:
            self._scroll += _SCROLL[typed]
        elif self._confirming:
            self._confirming = False
            self._message = self._do("reset", lambda cell: cell.reset()) if typed[0] in "yY" else "reset left alone"
        elif typed[0] == "R":
            self._confirming = True
            self._message = "reset the emergency stop? Motion may be commanded again. y: yes, any other key: no"
        elif typed[0] == "h":
            self._shows_history, self._scroll = not self._shows_history, 0 if self._shows_history else MANY
        elif typed[0] == "\t":
            self._message = self._jogger.choose(self._watch.view("").nodes)
        elif typed[0] == "c":
            self._message = self._jogger.take(self._watch.cell)
        elif typed[0] in "q\x04":
            self._ended = True
        else:
            self._message = self._jogger.halt()

    def _tell(self, text: str) -> None:
        """Show something, and keep it among the events."""
        self._message, self._message_ns = text, monotonic_ns()
        self._history.add(strftime("%H:%M:%S", localtime()), text)

    def _stop(self) -> str:
        cell = self._watch.cell
        try:
            if cell is None:
                emergency_stop("sioms monitor", name="sioms monitor")
            else:
                cell.emergency_stop(why="sioms monitor")
        except OSError as error:
            return error.strerror or str(error)
        return "emergency stop: done"

    def _do(self, what: str, act: Any) -> str:
        cell = self._watch.cell
        if cell is None:
            return f"{what}: no daemon to send it to"
        try:
            act(cell)
        except OSError as error:
            return error.strerror or str(error)
        return f"{what}: done"


def _jog_keys(typed: str) -> list[str]:
    """Return the keys of a burst if all of them are for jogging, else nothing.

    Example:
        >>> _jog_keys("+>>"), _jog_keys("+q")
        (['+', '>', '>'], [])
    """
    keys = []
    while typed:
        key = next((key for key in monitor_jog.KEYS if typed.startswith(key)), "")
        if not key:
            return []
        keys.append(key)
        typed = typed[len(key) :]
    return keys


def _paint(lines: list[Text]) -> None:
    # Each line is cleared behind its end, not the screen before it: no flicker.
    ink = _PLAIN_INK if os.environ.get("NO_COLOR") else _INK
    out = "\r\n".join([f"{ink[line.style]}{line.text}\x1b[0m\x1b[K" for line in lines])
    sys.stdout.write(f"\x1b[H{out}\x1b[J")
    sys.stdout.flush()


@contextmanager
def _terminal() -> Iterator[None]:
    """Take the terminal: keys at once and unechoed, another screen; give it back whatever happens."""
    before = termios.tcgetattr(0)

    def take() -> None:
        tty.setcbreak(0)
        sys.stdout.write(_ENTER)
        sys.stdout.flush()

    def give_back() -> None:
        sys.stdout.write(_LEAVE)
        sys.stdout.flush()
        termios.tcsetattr(0, termios.TCSADRAIN, before)

    def suspend(number: int, _frame: object) -> None:
        """Give the terminal back, stop as the shell expects, take it again when we are let go on."""
        give_back()
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        signal.signal(signal.SIGTSTP, suspend)
        take()

    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda got, _: sys.exit(128 + got))
    signal.signal(signal.SIGTSTP, suspend)
    take()
    try:
        yield
    finally:
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        give_back()
