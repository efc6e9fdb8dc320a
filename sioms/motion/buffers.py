"""Command buffers of the axes of a bank: chunks of the written arrays, in order, one queue per axis."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .commands import Command

Chunk = tuple[int, NDArray[Any]]
"""Commands of one axis (COMMAND_DTYPE), in order."""


def cut(commands: NDArray[Any]) -> list[Chunk]:
    """Cut validated commands (COMMAND_DTYPE) by axis; the order within an axis is kept."""
    axis = commands["axis"]
    if len(commands) > 1 and (axis[1:] < axis[:-1]).any():
        order = np.argsort(axis, kind="stable")
        commands, axis = commands[order], axis[order]
    starts = np.flatnonzero(np.concatenate(([True], axis[1:] != axis[:-1]))).tolist()
    ends = [*starts[1:], len(commands)]
    return [(int(axis[i]), commands[i:j]) for i, j in zip(starts, ends, strict=True)]


class CommandBuffers:
    """One first-in first-out buffer per axis. ``count`` (n,) is how many records each holds.

    A written array is kept as it came, split by axis into views; a record becomes a Python object
    only when it is the next to run.
    """

    def __init__(self, n: int, capacity: int) -> None:
        self.capacity = capacity
        self.count = np.zeros(n, dtype=np.int64)
        self._chunks: list[deque[NDArray[Any] | tuple[Command]]] = [deque() for _ in range(n)]
        self._position = [0] * n

    def append(self, chunks: Sequence[Chunk]) -> None:
        """Append validated commands, cut by axis."""
        for axis, commands in chunks:
            self._chunks[axis].append(commands)
            self.count[axis] += len(commands)

    def append_commands(self, commands: Sequence[Command]) -> None:
        """Append a few commands that are Python objects already."""
        for command in commands:
            self._chunks[command.axis].append((command,))
            self.count[command.axis] += 1

    def pop(self, axis: int) -> Command | None:
        """Take the oldest command of an axis, None when it has none."""
        chunks = self._chunks[axis]
        if not chunks:
            return None
        i = self._position[axis]
        chunk = chunks[0]
        record = chunk[i]
        command = record if isinstance(record, Command) else Command._make(record.item())
        if i + 1 < len(chunk):
            self._position[axis] = i + 1
        else:
            chunks.popleft()
            self._position[axis] = 0
        self.count[axis] -= 1
        return command

    def clear(self, axes: NDArray[np.int64]) -> None:
        """Drop all commands of these axes."""
        for a in axes[self.count[axes] > 0].tolist():
            self._chunks[a].clear()
            self._position[a] = 0
        self.count[axes] = 0
