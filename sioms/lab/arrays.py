"""Arrays out of NPZ files that anybody may have written: whatever the bytes are, arrays or one sentence.

``mat`` does the same for MAT files.

What a file says of its sizes is looked at before any memory is given to it.
"""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

MOST_BYTES = 1 << 30
"""Bytes that the arrays of one file may take in memory."""
MOST_MEMBERS = 4096


class UnreadableError(ValueError):
    """The file holds no arrays that can be read; the message says which file, and why."""


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of an NPZ file, without those of Python objects.

    Raises:
        UnreadableError: it is none, it is damaged, or it is too large.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = [m for m in archive.infolist() if m.filename.endswith(".npy")]
            if not members:
                raise ValueError("the archive holds no arrays")
            if len(members) > MOST_MEMBERS:
                raise ValueError(f"{len(members)} arrays; at most {MOST_MEMBERS} are read")
            limit(sum(m.file_size for m in members))
            arrays = {m.filename.removesuffix(".npy"): _member(archive, m) for m in members}
    except Exception as error:  # readers raise whatever their parts raise: a dozen kinds, some of their own
        raise UnreadableError(f"read {path}: it is not an NPZ file, or is damaged: {words(error)}") from error
    return {name: array for name, array in arrays.items() if array is not None}


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any] | None:
    """Return an array, None for one of Python objects."""
    with archive.open(member) as file:
        shape, kind = _npy_head(file)
    if kind.hasobject:
        return None
    size = math.prod(shape) * kind.itemsize
    if size > member.file_size:
        raise ValueError(f"{member.filename} states {size} bytes of data and has {member.file_size}")
    with archive.open(member) as file:
        array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array


def _npy_head(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read(file)
    if any(n < 0 for n in shape):
        raise ValueError(f"an array of the shape {shape}")
    return shape, kind


def limit(size: int) -> None:
    """Refuse arrays that take too much memory; raises ValueError."""
    if size > MOST_BYTES:
        raise ValueError(f"its arrays take {size / 2**20:.0f} MiB of memory; at most {MOST_BYTES / 2**20:.0f} are read")


def words(error: Exception) -> str:
    """Return what an error says, in one line."""
    text = " ".join(str(error).split())
    return text[:200] or type(error).__name__
