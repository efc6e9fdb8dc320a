"""Positions that outlive their driver process: a small file for each block of axes, written in place.

While an axis is at rest (told to, and its reading still for STILL_NS) its entry holds where it is, marked "at rest";
the mark is taken away before anything moves it, and comes back, with the new place, when it rests again. That is a
write into the kernel's memory, at the begin and the end of a motion, and what a killed process has written is in the
file. What the kernel has not written out when the power goes is lost, so entries of an earlier boot count only if the
process that wrote them ended in order. Where a mark cannot be taken away (EIO, a full disk), the file is.
Why so: docs/decisions/0070 and 0610.

Concurrency: the one thread of the driver process. A process that starts replaces the file by one of its own, so
that one on its way out cannot write into it.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from struct import Struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sioms.motion import AxisSettings

from .blocks import AnyBlock, AxisBlock

MAGIC = b"SIOMSPOS"
HEADER = Struct("<8sIIQ32s8x")
"""Magic, number of axes, bytes of their names, 1 when its process ended in order, id of the boot."""
CLOSED, CLOSED_AT = Struct("<Q"), 16
MOST_BYTES = 1 << 20
AT_REST, HOMED = 1, 2
STILL_NS = 100_000_000
"""So long the reading of an axis at rest has stayed within its tolerance: servos go on settling after their set-points.
"""

Log = Callable[[str, str], None]


class Entry(NamedTuple):
    """What is kept of an axis: AT_REST and HOMED bits, what the device read, and the position that meant [unit]."""

    state: int
    raw: float
    position: float


class Contents(NamedTuple):
    """A file: entries by axis name, whether it was closed in order, and the boot it was written in."""

    entries: Mapping[str, Entry]
    closed: bool
    boot: str


def encode(contents: Contents) -> bytes:
    """Return the bytes of a file: header, names, then the columns state, raw and position."""
    names = "\n".join(contents.entries).encode()
    names += b"\n" * (-len(names) % 8)
    header = HEADER.pack(MAGIC, len(contents.entries), len(names), int(contents.closed), contents.boot.encode())
    state = np.array([entry.state for entry in contents.entries.values()], dtype="<i8")
    places = np.array([entry[1:] for entry in contents.entries.values()], dtype="<f8").reshape(-1, 2)
    return header + names + state.tobytes() + places.T.tobytes()


def decode(data: bytes) -> Contents:
    """Return what a file says.

    Raises:
        ValueError: it is none, or a torn one.
    """
    if len(data) < HEADER.size or not data.startswith(MAGIC):
        raise ValueError(f"{len(data)} bytes that are not a position file")
    _, count, length, closed, boot = HEADER.unpack_from(data)
    if len(data) != HEADER.size + length + 24 * count:
        raise ValueError(f"{len(data)} bytes; want {HEADER.size + length + 24 * count} for {count} axes")
    try:
        names = data[HEADER.size : HEADER.size + length].decode().split("\n")[:count]
        written_in = boot.rstrip(b"\0").decode()
    except UnicodeDecodeError:
        raise ValueError("its names are not text") from None
    state = np.frombuffer(data, "<i8", count, HEADER.size + length).tolist()
    raw, position = np.frombuffer(data, "<f8", 2 * count, HEADER.size + length + 8 * count).reshape(2, count).tolist()
    entries = {name: Entry(*entry) for name, *entry in zip(names, state, raw, position, strict=True)}
    return Contents(entries, bool(closed), written_in)


def offset_of(entry: Entry, settings: AxisSettings, raw: float) -> tuple[float | None, str]:
    """Return the offset that restores an axis, or None and why it is not restored.

    Args:
        entry: what was kept.
        settings: of the axis.
        raw: what its device reads now [unit].
    """
    rule, unit = settings.restore, settings.unit
    if rule is None:
        return None, "its configuration has no restore"
    if not entry.state & AT_REST:
        return None, "it was not known to be at rest when its driver ended"
    if not np.isfinite(raw):
        return None, "its device does not report its position"
    if not np.isfinite(entry.position - entry.raw):
        return None, "what was kept of it is not a number"
    if rule.when == "always":
        return entry.position - raw, ""
    if not abs(raw - entry.raw) <= rule.tolerance:
        return (
            None,
            f"its device reads {raw:g} {unit} and read {entry.raw:g} {unit}; at most {rule.tolerance:g} apart",
        )
    return entry.position - entry.raw, ""


class PositionFile:
    """The file of a block of axes (a ``Keeper`` of its bank).

    Args:
        path: of the file; its folder is made when it is not there.
        settings: of the axes.
        boot: id of this boot.
        log: takes level and text.

    Raises:
        OSError: it cannot be written.
    """

    def __init__(self, path: str, settings: Sequence[AxisSettings], boot: str, log: Log) -> None:
        self._settings, self._log = settings, log
        self._before = {axis.name: Entry(0, 0.0, 0.0) for axis in settings}
        self._why = "nothing was kept of it"
        known = self._read(path, boot)
        self._before.update({name: entry for name, entry in known.items() if name in self._before})
        data = bytearray(encode(Contents(self._before, False, boot)))
        self._path, self._data, self._fd = path, data, _replace(path, data)
        self._first, count = len(data) - 24 * len(settings), len(settings)
        self._state = np.frombuffer(data, "<i8", count, self._first)
        self._raw = np.frombuffer(data, "<f8", count, self._first + 8 * count)
        self._position = np.frombuffer(data, "<f8", count, self._first + 16 * count)
        self._tolerance = np.array([axis.restore.tolerance if axis.restore else 0.0 for axis in settings])
        self._still_at, self._still_ns = np.full(count, np.nan), np.zeros(count, dtype=np.int64)

    def _read(self, path: str, boot: str) -> Mapping[str, Entry]:
        """Return the entries of the file before this one that can be believed."""
        try:
            with open(path, "rb", opener=_at_once) as file:
                contents = decode(file.read(MOST_BYTES))
        except FileNotFoundError:
            return {}
        except ValueError as error:
            self._log("warning", f"positions are not restored: {path}: {error}")
            return {}
        if contents.closed or (boot and contents.boot == boot):
            return contents.entries
        self._why = "the machine went down without an orderly end"
        return {}

    def restored(self, raw: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return offsets and which axes are homed, by what was kept of them (motion.Keeper)."""
        offset, homed = np.zeros(len(self._settings)), np.zeros(len(self._settings), dtype=bool)
        for i, settings in enumerate(self._settings):
            if settings.restore is None:
                continue
            entry = self._before[settings.name]
            found, why = offset_of(entry, settings, float(raw[i]))
            if found is None:
                why = self._why if entry == Entry(0, 0.0, 0.0) else why
                self._log("warning", f"{settings.name}: position not restored, not homed: {why}")
                continue
            offset[i], homed[i] = found, bool(entry.state & HOMED)
            at = f"position {raw[i] + found:g} {settings.unit} restored"
            self._log("info", f"{settings.name}: {at}, {'homed' if homed[i] else 'not homed'}")
        return offset, homed

    def note(
        self,
        at_rest: NDArray[np.bool_],
        homed: NDArray[np.bool_],
        raw: NDArray[np.float64],
        position: NDArray[np.float64],
        now_ns: int,
    ) -> None:
        """Keep the present state (motion.Keeper); whenever this is cut short, no entry is wrong."""
        moved = ~(np.abs(raw - self._still_at) <= self._tolerance)
        if np.count_nonzero(moved):
            self._still_at[moved], self._still_ns[moved] = raw[moved], now_ns
        at_rest = at_rest & (now_ns - self._still_ns >= STILL_NS)
        state = at_rest * AT_REST + homed * HOMED
        changed = (state != self._state) | (at_rest & ((raw != self._raw) | (position != self._position)))
        if self._fd < 0 or not np.count_nonzero(changed):
            return
        try:
            self._enter(changed, state, changed & at_rest, raw, position)
        except OSError as error:
            self._give_up(error)

    def _enter(
        self,
        changed: NDArray[np.bool_],
        state: NDArray[np.int64],
        rests: NDArray[np.bool_],
        raw: NDArray[np.float64],
        position: NDArray[np.float64],
    ) -> None:
        """Write what has changed; where an axis is counts only at rest, so it is written unmarked, then marked."""
        unmarked = np.where(rests, 0, state)
        differs = changed & (unmarked != self._state)
        if np.count_nonzero(differs):
            self._state[differs] = unmarked[differs]
            self._write(0, differs)
        if np.count_nonzero(rests):
            self._raw[rests], self._position[rests] = raw[rests], position[rests]
            self._write(1, rests)
            self._write(2, rests)
            self._state[rests] = state[rests]
            self._write(0, rests)

    def _write(self, column: int, rows: NDArray[np.bool_]) -> None:
        """Write rows of a column, and what lies between them."""
        chosen = np.flatnonzero(rows)
        first = self._first + 8 * column * len(rows)
        self._put(first + 8 * int(chosen[0]), first + 8 * int(chosen[-1]) + 8)

    def _put(self, first: int, end: int) -> None:
        if os.pwrite(self._fd, memoryview(self._data)[first:end], first) != end - first:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _give_up(self, error: OSError) -> None:
        """Keep nothing from now on, and see that nobody believes what has been kept."""
        self._log("error", f"write {self._path}: {error.strerror}; positions are not kept until the next start")
        with suppress(OSError):
            os.ftruncate(self._fd, 0)
        with suppress(OSError):
            if os.path.samestat(os.fstat(self._fd), os.stat(self._path)):  # and not a successor's
                _forget(self._path, self._log)
        self.let_go()

    def close(self) -> None:
        """Say that the process ended in order, and wait until that is on the disk."""
        if self._fd < 0:
            return
        try:
            os.fsync(self._fd)
            CLOSED.pack_into(self._data, CLOSED_AT, 1)
            self._put(CLOSED_AT, CLOSED_AT + CLOSED.size)
            os.fsync(self._fd)
        except OSError as error:
            self._give_up(error)
        self.let_go()

    def let_go(self) -> None:
        """Write nothing from now on; without ``close`` before it, that is no orderly end."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _at_once(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe would hold up the driver


def _replace(path: str, data: bytes | bytearray) -> int:
    """Put a new file in the place of an old one, on the disk before this returns; return its descriptor."""
    os.makedirs(os.path.dirname(path), exist_ok=True)
    fresh = f"{path}.new"
    with suppress(FileNotFoundError):
        os.unlink(fresh)  # of a process that was killed, or no file at all
    fd = os.open(fresh, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
    try:
        if os.write(fd, data) != len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), fresh)
        os.fsync(fd)
        os.replace(fresh, path)
    except OSError:
        os.close(fd)
        os.unlink(fresh)
        raise
    folder = os.open(os.path.dirname(path), os.O_RDONLY | os.O_DIRECTORY)
    os.fsync(folder)
    os.close(folder)
    return fd


def _forget(path: str, log: Log) -> None:
    """Take away what was kept before, as the axes will move without being followed."""
    try:
        os.unlink(path)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        log("error", f"remove {path}: {error.strerror}; remove it before the next start: it will be wrong")


def boot_id() -> str:
    """Return the id of this boot, '' when the system does not tell it; a service has it from its unit."""
    given = os.environ.get("SIOMS_BOOT_ID", "")
    if given:
        return given.replace("-", "")[:32]
    try:
        with open("/proc/sys/kernel/random/boot_id", encoding="ascii") as file:
            return file.read().strip().replace("-", "")
    except OSError:
        return ""


def keep_positions(folder: str, device: str, blocks: Sequence[AnyBlock], log: Log) -> list[PositionFile]:
    """Give the banks whose axes ask for it a file each; return the files.

    Args:
        folder: where they are, '' when none is configured.
        device: name of the device.
        blocks: its blocks.
        log: takes level and text.
    """
    files = []
    for block in blocks:
        if not isinstance(block, AxisBlock) or not any(axis.restore for axis in block.bank.settings):
            continue
        name = f"{device}.{block.spec.name}" if block.spec.name else device
        if not folder:
            log("warning", f"{name}: positions are not kept: give [workcell] a state_folder")
            continue
        path = os.path.join(folder, f"{name}.positions")
        try:
            file = PositionFile(path, block.bank.settings, boot_id(), log)
        except OSError as error:
            log("error", f"{name}: positions are not kept: {error}")
            _forget(path, log)
            continue
        block.bank.keeper = file
        files.append(file)
    return files
