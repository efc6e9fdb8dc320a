"""The shared-memory page of one block: a header and a ring of snapshots.

One driver process writes, any number of processes read, and reading takes no system call: the
reader copies the newest snapshot out of the ring and checks its number before and after.

Layout (little endian; offsets in bytes)::

    0    magic "SIOMSpg1"          40  offset of the first slot
    8    version u32, class u32    48  lease_ns: alive_ns older than this = driver hung
    16   channels u32, fields u32  56  generation of the driver process
    24   slots (a power of two)    64  driver state u32, daemon state u32 (PageState)
    32   bytes of a slot           72  head: number of the newest snapshot, 0 = none yet
                                   80  alive_ns: stamped every tick by the driver
    88   device: random number of the driver process, the same in all its pages
    96   reason: UTF-8 text, NUL padded, why the state is not good (160 bytes)
    256  slots

    slot: number u64, stamp_ns u64, tick u64, as_of_ns u64, then one array of 8-byte values a field

A snapshot shows everything that took effect before its ``as_of_ns``. An acknowledgement carries the
instant of its effect, so the first snapshot with an ``as_of_ns`` not before that is the one that shows it.

A snapshot is written with its number zeroed, and published by its number and then by the head, so
a writer killed half-way leaves the preceding snapshot the newest. The ring lets a reader that was
asleep find every edge of the recent past.

Concurrency: one writer thread; readers anywhere. The stores of number, payload and head must not be
reordered: x86 keeps stores in order; elsewhere an uncontended lock is passed as a fence.
"""

import os
from struct import Struct, pack_into, unpack_from

from .flags import NodeClass, PageState
from .records import READ, READ_SIZE
from .text import printable

MAGIC = b"SIOMSpg1"
VERSION = 2
HEADER_SIZE = 256
SLOT_HEADER = 32
REASON_OFFSET = 96
REASON_SIZE = 160
_GOOD = PageState.GOOD | PageState.GOOD << 32
_HEAD, _ALIVE, _LEASE, _STATES, _DEVICE = 72 // 8, 80 // 8, 48 // 8, 64 // 8, 88 // 8
HEADER_FIELDS = {
    "magic": "8s", "version": "I", "node_class": "I", "channels": "I", "fields": "I", "slots": "Q", "slot_size": "Q",
    "first_slot": "Q", "lease_ns": "Q", "generation": "Q", "driver_state": "I", "daemon_state": "I", "head": "Q",
    "alive_ns": "Q", "device": "Q", "reason": f"{REASON_SIZE}s",
}  # fmt: skip
"""The header, field by field, in codes of struct."""
_HEADER = Struct("<" + "".join([*HEADER_FIELDS.values()][:12]))
_SLOT = Struct("<QQQQ")
AS_OF = Struct("<24xQ").unpack_from
"""Takes the instant up to which a copied snapshot shows everything out of it, in a tuple of one."""

_ORDERED = os.uname().machine in ("x86_64", "i686", "AMD64")
"""Whether stores become visible, and loads are made, in the order of the program."""

if _ORDERED:

    def fence() -> None:
        """Keep store order: nothing to do, this processor does."""

else:
    from _thread import allocate_lock

    _lock = allocate_lock()

    def fence() -> None:
        """Keep store order: an acquire and a release."""
        with _lock:
            pass


class PageError(Exception):
    """The page is not one of ours, or of another version."""


class NotReadable(Exception):
    """The page must not be read now: the driver is starting, gone, hung or in fault.

    Args:
        state: why, as a PageState; STALE also when the lease has run out.
        reason: sentence written by the driver or the daemon, may be empty.
    """

    def __init__(self, state: PageState, reason: str) -> None:
        super().__init__(reason)
        self.state = state
        self.reason = reason


def slot_size(node_class: NodeClass, channels: int) -> int:
    """Return the bytes of one snapshot."""
    return SLOT_HEADER + READ_SIZE[node_class] * channels


def page_size(node_class: NodeClass, channels: int, slots: int) -> int:
    """Return the bytes of a page with a ring of the given number of slots (a power of two)."""
    return HEADER_SIZE + slots * slot_size(node_class, channels)


def _write_reason(buffer: memoryview, text: str) -> None:
    encoded = printable(text).encode()[: REASON_SIZE - 1]
    buffer[REASON_OFFSET : REASON_OFFSET + REASON_SIZE] = encoded.ljust(REASON_SIZE, b"\0")


class PageWriter:
    """The driver's side of a page, in a writable buffer of page_size bytes.

    Args:
        buffer: zeroed memory, mapped writable.
        node_class: class of the block.
        channels: number of channels.
        slots: length of the ring, a power of two of at least 4.
        lease_ns: how old ``alive_ns`` may get before readers call the driver hung.
        generation: distinguishes successive driver processes of one device.
        device: number of the driver process, unlike that of any other.
    """

    def __init__(
        self,
        buffer: memoryview,
        node_class: NodeClass,
        channels: int,
        slots: int,
        lease_ns: int,
        generation: int,
        device: int = 0,
    ) -> None:
        if slots < 4 or slots & (slots - 1):
            raise PageError(f"lay out page: {slots} slots; must be a power of two of at least 4")
        fields = len(READ[node_class])
        size = slot_size(node_class, channels)
        _HEADER.pack_into(
            buffer, 0, MAGIC, VERSION, node_class, channels, fields, slots, size, HEADER_SIZE, lease_ns,
            generation, PageState.STARTING, PageState.GOOD,
        )  # fmt: skip
        self._bytes = buffer.cast("B")
        self._words = self._bytes.cast("Q")
        self._words[_DEVICE] = device
        self._mask = slots - 1
        self._size = size
        self._number = 0

    @property
    def number(self) -> int:
        """Number of the newest snapshot, 0 before the first."""
        return self._number

    def published(self, number: int) -> None:
        """Note that snapshots have been written up to this number, by somebody else in this process."""
        self._number = number

    @property
    def as_of_ns(self) -> int:
        """``as_of_ns`` of the newest snapshot, 0 before the first."""
        return self._words[(HEADER_SIZE + (self._number & self._mask) * self._size >> 3) + 3]

    def alive(self, now_ns: int) -> None:
        """Stamp the driver as alive [ns, CLOCK_MONOTONIC]."""
        self._words[_ALIVE] = now_ns

    def publish(self, payload: memoryview, stamp_ns: int, tick: int, as_of_ns: int) -> None:
        """Publish one snapshot of all channels.

        Args:
            payload: the field arrays one after the other, ``memoryview`` of bytes.
            stamp_ns: time the values hold for [ns, CLOCK_MONOTONIC].
            tick: number of the driver's tick.
            as_of_ns: what took effect before this instant is shown [ns, CLOCK_MONOTONIC].
        """
        number = self._number + 1
        offset = HEADER_SIZE + (number & self._mask) * self._size
        word = offset >> 3
        words = self._words
        words[word] = 0
        fence()
        words[word + 1] = stamp_ns
        words[word + 2] = tick
        words[word + 3] = as_of_ns
        self._bytes[offset + SLOT_HEADER : offset + self._size] = payload
        fence()
        words[word] = number
        words[_HEAD] = number
        self._number = number

    def set_state(self, state: PageState, reason: str = "") -> None:
        """Set the driver's state word, and the reason for a state that is not good."""
        _write_reason(self._bytes, reason)
        fence()
        pack_into("<I", self._bytes, 64, state)

    def release(self) -> None:
        """Drop the views, so that the mapping can be closed."""
        self._words.release()
        self._bytes.release()


class PageCopy(PageWriter):
    """The writer's side of a copy of another machine's page: snapshots are put into it as they are there."""

    def put(self, raw: bytes) -> None:
        """Publish a snapshot of the other page, slot header included, unless it is an older one."""
        number = int.from_bytes(raw[:8], "little")
        if number <= self._number:
            return
        offset = HEADER_SIZE + (number & self._mask) * self._size
        word = offset >> 3
        words = self._words
        words[word] = 0
        fence()
        self._bytes[offset + 8 : offset + self._size] = raw[8:]
        fence()
        words[word] = number
        words[_HEAD] = number
        self._number = number

    def put_all(self, raw: bytes) -> None:
        """Publish snapshots of the other page, one after the other, as ``put`` each; a run of numbers goes at once."""
        size, numbers = self._size, memoryview(raw).cast("Q")[:: self._size >> 3].tolist()
        if not numbers or numbers[0] <= self._number or numbers != list(range(numbers[0], numbers[0] + len(numbers))):
            for at in range(0, len(raw), size):
                self.put(raw[at : at + size])
            return
        at = 0
        while at < len(numbers):
            start = numbers[at] & self._mask
            count = min(len(numbers) - at, self._mask + 1 - start)
            self._put_run(start, count, bytearray(raw[at * size : (at + count) * size]))
            at += count

    def _put_run(self, start: int, count: int, run: bytearray) -> None:
        offset, step = HEADER_SIZE + start * self._size, self._size >> 3
        theirs = memoryview(run).cast("Q")[::step]
        ours = self._words[offset >> 3 : (offset >> 3) + count * step : step]
        numbers = memoryview(theirs.tobytes()).cast("Q")
        ours[:] = theirs[:] = memoryview(bytes(8 * count)).cast("Q")
        fence()
        self._bytes[offset : offset + count * self._size] = run
        fence()
        ours[:] = numbers
        self._number = self._words[_HEAD] = numbers[-1]

    def set_condition(self, alive_ns: int, driver: int, daemon: int, reason: bytes = b"") -> None:
        """Set what readers judge the page by: when its driver was alive, both states, and why one is not good."""
        words = self._words
        if words[_STATES] != (states := driver | daemon << 32):
            self._bytes[REASON_OFFSET : REASON_OFFSET + REASON_SIZE] = reason[: REASON_SIZE - 1].ljust(
                REASON_SIZE, b"\0"
            )
            fence()
            words[_STATES] = states
        words[_ALIVE] = alive_ns


def set_daemon_state(buffer: memoryview, state: PageState, reason: str) -> None:
    """Set the daemon's state word in a mapped page (the daemon's only store in it)."""
    _write_reason(buffer, reason)
    fence()
    pack_into("<I", buffer, 68, state)


class PageReader:
    """A reader of a page in a read-only mapping.

    Args:
        buffer: the mapping (``mmap`` object; slices of it copy).

    Raises:
        PageError: no page of this version.
    """

    __slots__ = (
        "_buffer",
        "_mask",
        "_size",
        "_words",
        "channels",
        "device",
        "generation",
        "node_class",
        "slots",
    )

    def __init__(self, buffer) -> None:  # type: ignore[no-untyped-def]  # mmap or bytes-like whose slices copy
        magic, version, cls, channels, _, slots, size, _, _, generation, _, _ = _HEADER.unpack_from(buffer, 0)
        if magic != MAGIC or version != VERSION:
            raise PageError(f"map page: magic {magic!r}, version {version}; want {MAGIC!r}, {VERSION}")
        self._buffer = buffer
        self._words = memoryview(buffer).cast("Q")
        self._mask = slots - 1
        self._size = size
        self.channels: int = channels
        self.node_class = NodeClass(cls)
        self.slots: int = slots
        self.generation: int = generation
        self.device: int = self._words[_DEVICE]

    @property
    def head(self) -> int:
        """Number of the newest snapshot; 0 before the first."""
        return self._words[_HEAD]

    @property
    def alive_ns(self) -> int:
        """Last stamp of the driver [ns, CLOCK_MONOTONIC]."""
        return self._words[_ALIVE]

    @property
    def lease_ns(self) -> int:
        """How old ``alive_ns`` may get before the driver counts as hung."""
        return self._words[_LEASE]

    @property
    def as_of_ns(self) -> int:
        """``as_of_ns`` of the newest snapshot, 0 before the first; it may be that of the one after it."""
        offset = HEADER_SIZE + (self._words[_HEAD] & self._mask) * self._size
        return self._words[(offset >> 3) + 3] if self._words[_HEAD] else 0

    def condition(self) -> tuple[int, int, int, bytes]:
        """Return what readers judge the page by: when its driver was alive, both states, and why one is not good."""
        states = self._words[_STATES]
        reason = b"" if states == _GOOD else self._buffer[REASON_OFFSET : REASON_OFFSET + REASON_SIZE].split(b"\0")[0]
        return self._words[_ALIVE], states & 0xFFFFFFFF, states >> 32, reason

    def check(self, now_ns: int) -> None:
        """Raise NotReadable unless driver and daemon call the page good and the lease holds."""
        words = self._words
        if words[_STATES] != _GOOD or now_ns - words[_ALIVE] > words[_LEASE]:
            self._refuse(now_ns)

    def latest(self, now_ns: int) -> bytes:
        """Copy the newest snapshot, slot header included.

        Args:
            now_ns: the time [ns, CLOCK_MONOTONIC], for the lease.

        Raises:
            NotReadable: the driver is starting, hung, gone or in fault: never old data as new.
        """
        words = self._words
        if words[_STATES] != _GOOD or now_ns - words[_ALIVE] > words[_LEASE]:
            self._refuse(now_ns)
        while True:
            number = words[_HEAD]
            offset = HEADER_SIZE + (number & self._mask) * self._size
            raw: bytes = self._buffer[offset : offset + self._size]
            # The writer may have lapped us since we read the head; it clears the number before it writes.
            if words[offset >> 3] == number and number:
                if _ORDERED or raw[:8] == number.to_bytes(8, "little"):
                    return raw
                continue
            if number == 0:
                raise NotReadable(PageState.STARTING, "nothing published yet")

    def numbered(self, number: int) -> bytes | None:
        """Copy a snapshot of the ring by its number; None when it is overwritten or not there yet."""
        offset = HEADER_SIZE + (number & self._mask) * self._size
        raw: bytes = self._buffer[offset : offset + self._size]
        if number > 0 and self._words[offset >> 3] == number and raw[:8] == number.to_bytes(8, "little"):
            return raw
        return None

    def between(self, first: int, last: int) -> bytes:
        """Copy the snapshots of these numbers, one after the other, but for those that are overwritten or not there."""
        size, start = self._size, first & self._mask
        before_end = min(last + 1 - first, self.slots - start)
        raw: bytes = self._buffer[HEADER_SIZE + start * size : HEADER_SIZE + (start + before_end) * size]
        if before_end < last + 1 - first:
            raw += self._buffer[HEADER_SIZE : HEADER_SIZE + (last + 1 - first - before_end) * size]
        fence()
        # The writer comes to the first one's slot when the one before it in the ring has become the head.
        is_whole = self._words[_HEAD] < first + self._mask
        if is_whole and memoryview(raw).cast("Q")[:: size >> 3].tolist() == list(range(first, last + 1)):
            return raw
        return b"".join([one for one in map(self.numbered, range(first, last + 1)) if one is not None])

    def slots_view(self) -> memoryview:
        """Return the memory of the ring as 8-byte words, for who takes many snapshots at once.

        It may change at any time; a snapshot that was copied is good if its number still stands in the ring
        afterwards.
        """
        return self._words[HEADER_SIZE // 8 : (HEADER_SIZE + self.slots * self._size) // 8]

    @property
    def states(self) -> tuple[PageState, PageState]:
        """How driver and daemon call the page."""
        driver, daemon = unpack_from("<II", self._buffer, 64)
        return PageState(driver), PageState(daemon)

    def release(self) -> None:
        """Drop the view, so that the mapping can be closed."""
        self._words.release()

    def _refuse(self, now_ns: int) -> None:
        """Raise NotReadable with the reason, unless the page has become good meanwhile."""
        words = self._words
        driver, daemon = unpack_from("<II", self._buffer, 64)
        reason = self._buffer[REASON_OFFSET : REASON_OFFSET + REASON_SIZE].split(b"\0")[0]
        text = printable(reason.decode("utf-8", "replace"))
        if daemon != PageState.GOOD:
            raise NotReadable(PageState(daemon), text)
        if driver != PageState.GOOD:
            raise NotReadable(PageState(driver), text)
        age_ns, lease_ns = now_ns - words[_ALIVE], words[_LEASE]
        if age_ns > lease_ns:  # else it has come back since the caller looked
            raise NotReadable(
                PageState.STALE,
                f"its driver has not ticked for {age_ns / 1e9:.3f} s (lease {lease_ns / 1e9:.3f} s)",
            )


def slot_header(raw: bytes) -> tuple[int, int, int]:
    """Return (number, stamp_ns, tick) of a copied snapshot."""
    number, stamp_ns, tick, _ = _SLOT.unpack_from(raw, 0)
    return number, stamp_ns, tick


def as_of_ns(raw: bytes) -> int:
    """Return the instant up to which a copied snapshot shows everything [ns, CLOCK_MONOTONIC]."""
    (instant_ns,) = AS_OF(raw)
    return int(instant_ns)
