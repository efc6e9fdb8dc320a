"""The file system: calls of the kernel become calls of the client library, on behalf of who calls.

Concurrency: the threads of libfuse, one for a call; ``Keeper`` renews leases, ``Notifier`` wakes who polls.
"""

from __future__ import annotations

import ctypes
import errno
import functools
import json
import os
import stat
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import mfusepy

from sioms.client.stopping import emergency_stop, taken
from sioms.documents import json_of
from sioms.protocol.flags import READONLY, Request
from sioms.protocol.socketpath import cell_address
from sioms.protocol.stopfile import open_stop_request
from sioms.protocol.text import printable

from ..prompt import Prompt
from .callers import Caller, acting_as, caller
from .opened import NodeFile, Patience
from .sessions import Sessions
from .tree import LOG, STOP, NodePlace, Tree
from .watching import Keeper, Notifier

MAGIC = ord("S")
"""Type of the ioctl requests: ``_IO('S', request)``, or ``_IOWR('S', request, char[N])`` with JSON in and out."""
MOST_TEXT = 4096
SENTENCES = 500
"""Refusals that ``.log`` keeps."""
CLOSING_S = 0.5
"""How long an output is waited for that is perhaps being closed [s]."""
_NONBLOCK = os.O_NONBLOCK
_fuse = mfusepy._libfuse


def served(function: Callable[..., Any]) -> Callable[..., Any]:
    """Make an operation of a method: what is refused is an errno, and its sentence stands in ``.log``."""

    @functools.wraps(function)
    def operation(self: Nodes, path: str, *arguments: Any) -> Any:
        try:
            with self.prompt.word():
                return function(self, path, *arguments)
        except OSError as error:
            # Shells and completion look for files all the time, and who opens a file asks whether it is a terminal.
            is_look = function.__name__ == "getattr" and error.errno == errno.ENOENT
            is_of_others = function.__name__ == "ioctl" and arguments[0] >> 8 & 0xFF != MAGIC
            if not (is_look or is_of_others):
                self._note(path, error)
            code = error.errno if error.errno and error.errno > 0 else errno.EIO
            raise OSError(code, error.strerror) from None
        except Exception as error:
            self._note(path, OSError(errno.EIO, f"internal error: {error!r}"))
            raise OSError(errno.EIO, "internal error") from error

    return operation


class Nodes(mfusepy.Operations):  # type: ignore[misc]
    """Nodes as files.

    Args:
        lease_s: of outputs [s].
        ready: called when the file system is there.
    """

    use_ns = True

    def __init__(self, lease_s: float, ready: Callable[[], None]) -> None:
        self.sentences: deque[tuple[int, str]] = deque(maxlen=SENTENCES)
        self._lease_s, self._ready = lease_s, ready
        self._sessions = Sessions()
        self._patience = Patience(lambda: bool(_fuse.fuse_interrupted()))
        self._files: dict[int, NodeFile | bytes | None] = {}
        self._number = 0
        self._address = cell_address()
        self._began_ns = time.time_ns()

    def init(self, path: str) -> None:
        """Begin, in the process that serves."""
        self._keeper = Keeper(self._open_files, self._lease_s)
        self._notifier = Notifier(_fuse)
        self.prompt = Prompt()
        self._ready()

    def _open_files(self) -> Iterator[NodeFile]:
        return (file for file in list(self._files.values()) if isinstance(file, NodeFile))

    def _note(self, path: str, error: OSError) -> None:
        """Put a refusal into ``.log``, for its user."""
        uid, _, tid = mfusepy.fuse_get_context()
        self.sentences.append((uid, f"{_now()} {_name(tid)} {path}: {error.strerror or error}"))

    # --- who, and what ---------------------------------------------------------------------------

    def _caller(self) -> Caller:
        return caller(*mfusepy.fuse_get_context())

    def _tree(self) -> Tree:
        return self._sessions.of(self._caller()).tree()

    def _place(self, path: str) -> NodePlace:
        place = self._tree().place(path)
        if place is None:
            raise OSError(errno.ENOENT, "there is no such node, or you may not read it")
        return place

    def _file(self, handle: int) -> NodeFile:
        """Return an open file, which the calling process uses from now on."""
        file = self._files[handle]
        if not isinstance(file, NodeFile):
            raise OSError(errno.EINVAL, "this file is not a node")
        tid = mfusepy.fuse_get_context()[2]
        if not file.knows(tid):
            file.use(tid, self._caller().process)
        return file

    @served
    def getattr(self, path: str, _handle: int | None = None) -> dict[str, Any]:
        """Tell what a file is."""
        if path == "/":
            return self._about(stat.S_IFDIR | 0o555)
        if path == f"/{STOP}":
            return self._about(stat.S_IFREG | 0o222)
        if path == f"/{LOG}":
            return self._about(stat.S_IFREG | 0o444)
        tree = self._tree()
        if tree.folder(path) is not None:
            return self._about(stat.S_IFDIR | 0o555)
        place = tree.place(path)
        if place is None:
            raise OSError(errno.ENOENT, "no such node")
        return self._about(stat.S_IFREG | (0o444 if place.read_only else 0o666))

    def _about(self, mode: int) -> dict[str, Any]:
        when = dict.fromkeys(("st_atime", "st_mtime", "st_ctime"), self._began_ns)
        return {"st_mode": mode, "st_nlink": 1 + stat.S_ISDIR(mode), "st_size": 0, "st_uid": os.getuid(), **when}

    @served
    def readdir(self, path: str, _handle: int) -> list[str]:
        """List a folder."""
        own = [STOP, LOG] if path == "/" else []
        try:
            inside = self._tree().folder(path)
        except OSError as error:
            if path != "/":
                raise
            self._note(path, error)
            return [".", "..", *own]  # without a daemon there are no nodes, and the stop is there
        if inside is None:
            raise OSError(errno.ENOENT, "no such folder")
        return [".", "..", *own, *inside]

    # --- open and close --------------------------------------------------------------------------

    @served
    def open(self, path: str, flags: int) -> int:
        """Open a file: an output for writing, which makes it its user's own, or its companion for reading."""
        writes = flags & os.O_ACCMODE != os.O_RDONLY
        if path == f"/{LOG}":
            if writes:
                raise OSError(errno.EACCES, "it is written by the mount alone")
            uid = mfusepy.fuse_get_context()[0]
            text = "".join(line + "\n" for whose, line in list(self.sentences) if uid in (0, whose))
            return self._new(text.encode())
        if path == f"/{STOP}":
            return self._new(None)
        place = self._place(path)
        who = self._caller()
        nonblock = bool(flags & _NONBLOCK)
        if not writes:
            name = place.name if place.read_only else place.name + READONLY
            cell, node = self._sessions.of(who).ask(lambda cell: (cell, cell.open(name)))
            return self._new(self._made(cell, node, who, place, nonblock=nonblock, owned=False))
        if place.read_only:
            raise OSError(errno.EACCES, f"open {place.name} for writing: it can only be read")
        cell = self._sessions.new(who, f"{who} by sioms mount")
        try:
            node = self._taken(cell, place.name, "rw" if flags & os.O_ACCMODE == os.O_RDWR else "w")
        except BaseException:
            cell.close()
            raise
        return self._new(self._made(cell, node, who, place, nonblock=nonblock, owned=True))

    def _taken(self, cell: Any, name: str, mode: str) -> Any:
        """Open an output; what has just been closed here the kernel tells us a moment later."""
        try:
            return cell.open(name, mode, lease=self._lease_s)
        except OSError as error:
            if error.errno != errno.EBUSY or not any(file.is_closing for file in self._open_files()):
                raise
            with suppress(TimeoutError):
                return cell.open(name, mode, CLOSING_S, lease=self._lease_s)
            raise

    def _made(self, cell: Any, node: Any, who: Caller, place: NodePlace, *, nonblock: bool, owned: bool) -> NodeFile:
        if owned:
            self.prompt.date(node, asked_before=False)  # nobody has the file yet
        return NodeFile(cell, node, who, self._patience, binary=place.binary, nonblock=nonblock, owned=owned)

    def _new(self, file: NodeFile | bytes | None) -> int:
        self._number += 1
        self._files[self._number] = file
        return self._number

    @served
    def create(self, path: str, _mode: int) -> int:
        """Refuse a file that is not there."""
        raise OSError(errno.ENOENT, "there is no such node, and none can be made here; `ls` lists them")

    def truncate(self, path: str, _length: int, _handle: int | None = None) -> None:
        """Do nothing: what was written has been carried out, and is nowhere to be cut off."""

    def flush(self, path: str, handle: int) -> None:
        """Note that one of the descriptors of a file has been closed, perhaps the last one."""
        file = self._files.get(handle)
        if isinstance(file, NodeFile):
            file.is_closing = True

    def release(self, path: str, handle: int) -> None:
        """Close a file."""
        file = self._files.pop(handle, None)
        if isinstance(file, NodeFile):
            self._notifier.forget(file)
            file.close()
            if file.rest:
                text = f"write {file.node.name}: its last line has no end, and was not carried out"
                self.sentences.append((file.who.uid, f"{_now()} {file.who} {path}: {text}"))

    # --- read, write, wait -----------------------------------------------------------------------

    @served
    def read(self, path: str, size: int, offset: int, handle: int) -> bytes:
        """Read a snapshot, or what ``.log`` was when it was opened."""
        file = self._files[handle]
        if isinstance(file, bytes):
            return file[offset : offset + size]
        return self._file(handle).read(size, offset)

    @served
    def write(self, path: str, data: bytes, _offset: int, handle: int) -> int:
        """Write commands, or stop the workcell."""
        if self._files[handle] is None:
            self._stop(printable(data.decode("utf-8", "replace").strip(), 200))
            return len(data)
        return self._file(handle).write(data, mfusepy.fuse_get_context()[2])

    def _stop(self, why: str) -> None:
        """Stop the workcell, past the daemon, with the rights of who calls."""
        who = self._caller()
        why = f"{why or 'a stop'}, by {who} through sioms mount"
        with acting_as(who):
            if "://" in self._address:
                emergency_stop(why, self._address, str(who))
                return
            request = open_stop_request(self._address)
        if request is None:
            raise OSError(errno.EPERM, "stop the workcell: no daemon has run here, or you have no right to stop it")
        try:
            if not taken(request, request.request(time.monotonic_ns(), who.process.pid, why)):
                raise OSError(errno.EIO, "stop the workcell: no driver has taken the stop; is any running?")
        finally:
            request.close()

    @served
    def fsync(self, path: str, _data_only: int, handle: int) -> None:
        """Wait until motion has ended."""
        if isinstance(self._files[handle], NodeFile):
            self._file(handle).settle(mfusepy.fuse_get_context()[2])

    @served
    def poll(self, path: str, handle: int, waiting: int | None, events: Any) -> None:
        """Tell whether there is a new snapshot, or room in the command buffer; wake who waits when that may change."""
        if not isinstance(self._files[handle], NodeFile):
            events[0] = 0x005
            return
        file = self._file(handle)
        if waiting:
            self._notifier.want(file, waiting)
        events[0] = file.events()

    @served
    def ioctl(self, path: str, number: int, _argument: Any, handle: int, _flags: int, data: int | None) -> None:
        """Send a request; JSON ``[argument, timeout]`` in, what it answers out."""
        number &= 0xFFFFFFFF
        size, kind, request = number >> 16 & 0x3FFF, number >> 8 & 0xFF, number & 0xFF
        if kind != MAGIC or request not in set(Request):
            raise OSError(errno.ENOTTY, f"request {number:#x}; want _IO('S', N) or _IOWR('S', N, char[...])")
        argument: Any = None
        timeout_s: float | None = 0.0
        if data and size and number >> 30 & 1:
            argument, timeout_s = _arguments(ctypes.string_at(data, size).split(b"\0")[0])
        file, tid = self._file(handle), mfusepy.fuse_get_context()[2]
        answer = json.dumps(file.ioctl(Request(request), argument, timeout_s, tid), default=_plain).encode() + b"\0"
        if data and size and number >> 31 & 1:
            if len(answer) > size:
                text = f"{Request(request).name}: the answer has {len(answer)} bytes; there is room for {size}"
                raise OSError(errno.EMSGSIZE, text)
            ctypes.memmove(data, answer, len(answer))


def _arguments(text: bytes) -> tuple[Any, float | None]:
    if not text:
        return None, 0.0
    try:
        value = json_of(text[:MOST_TEXT].decode())
    except ValueError as error:
        raise OSError(errno.EINVAL, f"its argument is not JSON: {error}") from None
    if not isinstance(value, list) or len(value) > 2:
        raise OSError(errno.EINVAL, "its argument; want JSON: [argument] or [argument, timeout in seconds]")
    argument = value[0] if value else None
    timeout_s = value[1] if len(value) > 1 else 0.0
    if timeout_s is not None and not isinstance(timeout_s, int | float):
        raise OSError(errno.EINVAL, f"its time-out {timeout_s!r}; want seconds, or null for ever")
    return argument, timeout_s


def _plain(value: Any) -> Any:
    """Return what JSON has no word for in other words: the attributes of an event, else its text."""
    names = getattr(type(value), "__slots__", ())
    return {name: getattr(value, name) for name in names} if names else str(value)


def _now() -> str:
    return time.strftime("%H:%M:%S", time.localtime())


def _name(tid: int) -> str:
    with suppress(OSError), open(f"/proc/{tid}/comm", encoding="utf-8", errors="replace") as file:
        return f"{printable(file.read().strip(), 32)}[{tid}]"
    return f"[{tid}]"
