"""What the outputs of a device are and shall be: the base of writes of single bits, and safe values until they are
confirmed.

A port is written whole, so a write of some of its bits begins from what the device has: what it read last, and what it
    has
acknowledged since. Nothing is begun from what was asked for: what the device refused or dropped does not come back.

A safe value is state, not a message: it is sent again until the device has acknowledged it and then reads so, whatever
was lost, refused or restarted in between; under a stop it is compared with every reading after that. Every write of a
port carries
the safe bits that are wanted of it. Why so: docs/decisions/0095-safe-outputs-are-state.md.

Pure; concurrency: the one thread of the driver process.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from msgspec import Struct

from .blocks import AnyBlock, AxisBlock, BinaryBlock, BlockSpec

WHOLE = -1
"""Mask of an analog value."""
NEAR = 0.005
"""Part of its range by which an analog output may read beside its safe value: converters are coarse."""
Key = tuple[int, int]


class Change(NamedTuple):
    """What is asked of one channel: some of its bits, or an analog value (mask WHOLE)."""

    mask: int
    value: float

    def over(self, base: float) -> float:
        """Return a value with this put over it."""
        if self.mask == WHOLE:
            return self.value
        return int(base) & ~self.mask | int(self.value) & self.mask

    def contradicts(self, other: Change) -> bool:
        """Tell whether it asks for something else than another change of the channel."""
        if self.mask == WHOLE:
            return self.value != other.value
        return (int(self.value) ^ int(other.value)) & self.mask & other.mask != 0


class _Safe(Struct):
    """Bits (or the value) of a channel that shall be safe."""

    mask: int
    value: float
    unsent: int
    """Those that the device has not acknowledged since they were wanted, or since it read otherwise."""
    unseen: int
    """Those that it has not read back since."""
    sent_at: int = 0


def safe_of(spec: BlockSpec, channel: int, bit: int = -1) -> Change | None:
    """Return the safe value of an output channel, or of one bit of it; None when it has none."""
    value = spec.safe[channel] if spec.writable and spec.safe else None
    if value is None:
        return None
    width = spec.channels[channel].width
    if not width:
        return Change(WHOLE, value)
    return Change(1 << bit if bit >= 0 else (1 << width) - 1, value)


class Outputs:
    """The outputs of a driver process."""

    def __init__(self) -> None:
        self._count = 0
        self._written: dict[Key, tuple[int, float]] = {}
        self._safe: dict[Key, _Safe] = {}

    # --- writes -----------------------------------------------------------------------------------

    def merged(self, block: AnyBlock, changes: Mapping[int, Change]) -> tuple[list[int], list[float]]:
        """Return channels and values to be written now: call it when the write goes out, not when it is asked for."""
        values = []
        for channel, change in changes.items():
            key = (id(block), channel)
            value = change.over(self._base(block, channel))
            wanted = self._safe.get(key)
            values.append(value if wanted is None else Change(wanted.mask, wanted.value).over(value))
        return list(changes), values

    def _base(self, block: AnyBlock, channel: int) -> float:
        written = self._written.get((id(block), channel))
        if written is not None:
            return written[1]
        return _reading(block, channel)

    def acknowledge(self, block: AnyBlock, channels: Sequence[int], values: Sequence[float]) -> None:
        """Note that the device has taken a write."""
        self._count += 1
        for channel, value in zip(channels, values, strict=True):
            key = (id(block), channel)
            self._written[key] = (self._count, value)
            wanted = self._safe.get(key)
            if wanted is not None:
                wanted.unsent &= ~wanted.mask if wanted.mask != WHOLE else 0
                wanted.sent_at = self._count

    def forget(self, blocks: Sequence[AnyBlock]) -> None:
        """The device is lost: it may have restarted, so nothing that it acknowledged holds, nor that it was safe."""
        ours = {id(block) for block in blocks}
        self._written = {key: value for key, value in self._written.items() if key[0] not in ours}
        for key, wanted in self._safe.items():
            if key[0] in ours:
                wanted.unsent = wanted.unseen = wanted.mask

    # --- safe values ------------------------------------------------------------------------------

    def want(self, block: AnyBlock, channel: int, safe: Change) -> None:
        """Want a safe value from now on."""
        key = (id(block), channel)
        wanted = self._safe.get(key)
        if wanted is None or safe.mask == WHOLE:
            self._safe[key] = _Safe(safe.mask, safe.value, safe.mask, safe.mask)
            return
        wanted.value = safe.over(wanted.value)
        for name in ("mask", "unsent", "unseen"):
            setattr(wanted, name, getattr(wanted, name) | safe.mask)

    def release(self, block: AnyBlock, changes: Mapping[int, Change]) -> None:
        """A client says what these outputs shall be."""
        for channel, change in changes.items():
            wanted = self._safe.get((id(block), channel))
            if wanted is None:
                continue
            wanted.mask, wanted.unsent, wanted.unseen = (
                0 if change.mask == WHOLE else bits & ~change.mask
                for bits in (wanted.mask, wanted.unsent, wanted.unseen)
            )
            if not wanted.mask:
                del self._safe[id(block), channel]

    def unsent(self, block: AnyBlock) -> dict[int, Change]:
        """Return the safe values that have to be sent."""
        return {
            channel: Change(wanted.mask, wanted.value)
            for (of, channel), wanted in self._safe.items()
            if of == id(block) and wanted.unsent
        }

    def unconfirmed(self, block: AnyBlock) -> bool:
        """Tell whether a safe value is wanted that the device has not confirmed."""
        return any(wanted.unseen for (of, _), wanted in self._safe.items() if of == id(block))

    # --- readings ---------------------------------------------------------------------------------

    def mark(self) -> int:
        """Return a mark of now: what is read after it shows all that has been acknowledged before it."""
        return self._count

    def read(self, block: AnyBlock, mark: int, is_stopped: Callable[[int], bool]) -> None:
        """Compare what the device has with what is wanted.

        Args:
            block: as it has been read.
            mark: when the reading began.
            is_stopped: whether a channel is under a stop: its safe value stays wanted.
        """
        for key in [k for k, (at, _) in self._written.items() if k[0] == id(block) and at <= mark]:
            del self._written[key]
        for key, wanted in [item for item in self._safe.items() if item[0][0] == id(block)]:
            if wanted.unsent or wanted.sent_at > mark:
                continue
            wanted.unseen = wanted.unsent = _differing(block, key[1], wanted)
            if not wanted.unseen and not is_stopped(key[1]):
                del self._safe[key]


def _differing(block: AnyBlock, channel: int, wanted: _Safe) -> int:
    """Return the bits of what is wanted that the device does not read."""
    if isinstance(block, BinaryBlock):
        return (int(block.data[channel]) ^ int(wanted.value)) & wanted.mask
    info = block.spec.channels[channel]
    range_ = (info.maximum or 0.0) - (info.minimum or 0.0)
    near = NEAR * (range_ or max(1.0, abs(wanted.value)))
    return 0 if abs(_reading(block, channel) - wanted.value) <= near else WHOLE


def _reading(block: AnyBlock, channel: int) -> float:
    if isinstance(block, AxisBlock):
        raise TypeError(f"outputs of {block.spec.name!r}: axes have none")
    return float(block.data[channel])
