"""Arrays out of NPZ and MAT files that anybody may have written: whatever the bytes are, arrays or one sentence.

What a file says of its sizes is looked at before any memory is given to it.
"""

from __future__ import annotations

import math
import os
import struct
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

MOST_BYTES = 1 << 30
"""Bytes that the arrays of one file may take in memory."""
MOST_MEMBERS = 4096
_NUMBERS = {
    "double",
    "single",
    "logical",
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
}
_COMPRESSED, _PIECE = 15, 1 << 16


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
            _limit(sum(m.file_size for m in members))
            arrays = {m.filename.removesuffix(".npy"): _member(archive, m) for m in members}
    except Exception as error:  # readers raise whatever their parts raise: a dozen kinds, some of their own
        raise UnreadableError(f"read {path}: it is not an NPZ file, or is damaged: {_words(error)}") from error
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


def read_mat(path: Path) -> dict[str, Any]:
    """Read the arrays of numbers of a MAT file up to version 7.2, as scipy gives them.

    Raises:
        UnreadableError: it is none, it is damaged, too large, or of version 7.3.
    """
    from scipy.io import loadmat, whosmat

    try:
        with path.open("rb") as file:
            if b"MATLAB 7.3" in file.read(128) or zipfile.is_zipfile(path):
                raise ValueError("it is of version 7.3, which is HDF5; save it with -v7")
        _limit_inflated(path)
        variables = [v for v in whosmat(path) if v[2] in _NUMBERS]  # what nests states its sizes further in
        _limit(sum(math.prod(shape) * 8 for _, shape, _ in variables))
        names = [name for name, _, _ in variables]
        found: dict[str, Any] = loadmat(path, squeeze_me=True, variable_names=names)
    except Exception as error:  # readers raise whatever their parts raise: a dozen kinds, some of their own
        raise UnreadableError(f"read {path}: it is not a MAT file, or is damaged: {_words(error)}") from error
    return {name: value for name, value in found.items() if not name.startswith("__")}


def _limit_inflated(path: Path) -> None:
    """Inflate the compressed elements of a MAT file, without keeping any of it: they state their sizes inside only."""
    with path.open("rb") as file:
        order = {b"IM": "<II", b"MI": ">II"}.get(file.read(128)[126:])
        total = 0
        while order and len(tag := file.read(8)) == 8:
            kind, left = struct.unpack(order, tag)
            if kind != _COMPRESSED:
                file.seek(left, os.SEEK_CUR)
                continue
            stream = zlib.decompressobj()
            while left and (part := file.read(min(left, _PIECE))):
                left -= len(part)
                while part:
                    total += len(stream.decompress(part, _PIECE))
                    _limit(total)
                    part = stream.unconsumed_tail


def _limit(size: int) -> None:
    if size > MOST_BYTES:
        raise ValueError(f"its arrays take {size / 2**20:.0f} MiB of memory; at most {MOST_BYTES / 2**20:.0f} are read")


def _words(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text[:200] or type(error).__name__
