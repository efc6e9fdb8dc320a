"""Arrays of numbers out of MAT files of versions 4 to 7.2 that anybody may have written: arrays, or one sentence.

What a file says of its sizes and shapes is looked at before any memory is given to it; compressed variables are
inflated as far as they are read. Structures are read as their parts, ``run.time``; cell arrays, text, sparse arrays,
objects and functions are no columns of numbers, and left out.

Source: MAT-File Format (MathWorks). Python alone reads it: the usual library is compiled, and a damaged file
ends the process that reads it.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.text import printable

from .arrays import MOST_MEMBERS, UnreadableError, limit, words

MOST_DIMENSIONS = 32
DEEPEST = 8
"""Structures within each other at most."""
LONGEST_NAME = 256
_PIECE = 1 << 16
_MATRIX, _COMPRESSED = 14, 15
_STORED = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
"""How the numbers of an element lie in the file, by its type."""
_CLASSES = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
"""What numbers an array holds, by its class; they may be stored as smaller ones."""
_OTHERS = {1: "a cell array", 3: "an object", 4: "text", 5: "a sparse array", 16: "a function", 17: "an object"}
_STRUCT = 2
_COMPLEX = 0x800
_STORED_4 = ("f8", "f4", "i4", "i2", "u2", "u1")
_OTHERS_4 = {1: "text", 2: "a sparse array"}

Found = dict[str, NDArray[Any]]


def read_mat(path: Path) -> Found:
    """Read the arrays of numbers of a MAT file, without dimensions of 1.

    Returns:
        By name; those of structures by ``name.field``.

    Raises:
        UnreadableError: it is none, it is damaged, too large, of version 7.3, or holds no numbers.
    """
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            head = file.read(128)
            if b"MATLAB 7.3" in head or head[124:128] in (b"\0\2IM", b"\2\0MI") or head.startswith(b"PK"):
                raise ValueError("it is of version 7.3, which is HDF5; save it with -v7")
            if len(head) < 20:
                raise ValueError(f"it has {len(head)} bytes")
            reader = _Reader()
            if 0 in head[:4]:
                file.seek(0)
                reader.version_4(file, size)
            else:
                reader.version_5(file, size, head)
    except (OSError, ValueError, struct.error, zlib.error) as error:
        raise UnreadableError(f"read {path}: it is not a MAT file, or is damaged: {words(error)}") from error
    if not reader.found:
        others = ", ".join(f"{name} is {what}" for name, what in reader.others.items()) or "it is empty"
        raise UnreadableError(f"read {path}: it holds no arrays of numbers: {printable(others, 300)}")
    return reader.found


class _Source(Protocol):
    """Where bytes come from."""

    def take(self, size: int) -> bytes:
        """Return exactly so many bytes; raises ValueError where there are fewer."""


class _File:
    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def take(self, size: int) -> bytes:
        data = self._file.read(size)
        if len(data) < size:
            raise ValueError(f"it ends {size - len(data)} bytes too early")
        return data


class _Inflated:
    """What a compressed element inflates to, as far as it is asked for."""

    def __init__(self, file: IO[bytes], left: int) -> None:
        self._file, self._left, self._stream = file, left, zlib.decompressobj()

    def take(self, size: int) -> bytes:
        pieces, wanted = [], size
        while wanted:
            packed = self._stream.unconsumed_tail
            if not packed:
                packed = self._file.read(min(self._left, _PIECE))
                self._left -= len(packed)
            piece = self._stream.decompress(packed, min(wanted, _PIECE))
            if not piece and (not packed or self._stream.eof):
                raise ValueError(f"a compressed variable ends {wanted} bytes too early")
            pieces.append(piece)
            wanted -= len(piece)
        return b"".join(pieces)

    def end(self) -> None:
        """Check that nothing comes any more, and the checksum."""
        packed = self._stream.unconsumed_tail + self._file.read(self._left)
        if self._stream.decompress(packed, 1) or not self._stream.eof:
            raise ValueError("a compressed variable does not end where it says")


class _Part:
    """The content of an element: nothing beyond it is read.

    Attributes:
        order: of bytes, as ``struct`` says it.
        left: bytes that have not been taken.
    """

    def __init__(self, source: _Source, size: int, order: str) -> None:
        self._source, self.left, self.order = source, size, order

    def take(self, size: int) -> bytes:
        """Return so many bytes; raises ValueError where it ends before."""
        if size > self.left:
            raise ValueError(f"an element of {size} bytes where {self.left} are left")
        self.left -= size
        return self._source.take(size)

    def skip(self) -> None:
        """Take the rest, and keep nothing of it."""
        while self.left:
            self.take(min(self.left, _PIECE))

    def head(self) -> tuple[int, int, bytes | None]:
        """Take the tag of an element: its type and size, and its content if that is in the tag."""
        tag = self.take(8)
        kind, size = struct.unpack(f"{self.order}II", tag)
        if small := kind >> 16:
            if small > 4:
                raise ValueError(f"a small element of {small} bytes")
            return kind & 0xFFFF, small, tag[4 : 4 + small]
        return kind, size, None

    def rest(self, size: int, content: bytes | None) -> bytes:
        """Take the content of an element, and what pads it."""
        if content is None:
            content = self.take(size)
            self.take(min(-size % 8, self.left))
        return content

    def element(self, most: int, what: str) -> tuple[int, bytes]:
        """Take a whole element of at most so many bytes: its type and content."""
        kind, size, content = self.head()
        if size > most:
            raise ValueError(f"{what} of {size} bytes; want at most {most}")
        return kind, self.rest(size, content)

    def whole_numbers(self, most: int, what: str) -> tuple[int, ...]:
        """Take an element of at most so many 32-bit numbers."""
        _, data = self.element(4 * most, what)
        return struct.unpack(f"{self.order}{len(data) // 4}i", data[: len(data) // 4 * 4])


class _Reader:
    """What has been read of a file.

    Attributes:
        found: arrays of numbers.
        others: what else there is, in words.
    """

    def __init__(self) -> None:
        self.found: Found = {}
        self.others: dict[str, str] = {}
        self._count = self._bytes = 0

    # --- version 5, which is that of 5 to 7.2 ---------------------------------------------------

    def version_5(self, file: IO[bytes], size: int, head: bytes) -> None:
        """Read the variables behind the head of a file of so many bytes."""
        order = {b"IM": "<", b"MI": ">"}.get(head[126:128])
        if order is None or struct.unpack(f"{order}H", head[124:126])[0] != 0x0100:
            raise ValueError(f"its head ends in {head[124:128]!r}; want version 1 and IM or MI")
        while len(tag := file.read(8)) == 8:
            kind, length = struct.unpack(f"{order}II", tag)
            begin = file.tell()
            if length > size - begin:
                raise ValueError(f"a variable of {length} bytes where {size - begin} are left")
            if kind == _MATRIX:
                self._matrix(_Part(_File(file), length, order), "", 0)
            elif kind == _COMPRESSED:
                inflated = _Inflated(file, length)
                kind, inner = struct.unpack(f"{order}II", inflated.take(8))
                limit(inner)
                part = _Part(inflated, inner, order)
                if kind == _MATRIX:
                    self._matrix(part, "", 0)
                part.skip()
                inflated.end()
            file.seek(begin + length)
        if tag:
            raise ValueError(f"{len(tag)} bytes at its end are no variable")

    def _matrix(self, part: _Part, inside: str, depth: int) -> None:
        """Read an array or a structure; ``inside`` is its name if it is a field."""
        self._count += 1
        if self._count > MOST_MEMBERS:
            raise ValueError(f"more than {MOST_MEMBERS} arrays")
        if not part.left:
            return  # an empty field
        flags = part.whole_numbers(2, "flags of an array")
        if len(flags) != 2:
            raise ValueError("an array without flags")
        kind = flags[0] & 0xFF
        if kind == 17:  # it has no shape
            self._leave_out(part, inside or self._name(part), kind)
            return
        shape = part.whole_numbers(MOST_DIMENSIONS, "a shape")
        if len(shape) < 2 or min(shape) < 0:
            raise ValueError(f"an array of the shape {shape}")
        name = self._name(part)
        name = inside or name
        if kind in _CLASSES:
            array = self._numbers(part, np.dtype(_CLASSES[kind]), shape, bool(flags[0] & _COMPLEX))
            if name:  # what functions take along has none
                self.found[name] = array
        elif kind == _STRUCT and math.prod(shape) == 1:
            self._fields(part, name, depth)
        else:
            self._leave_out(part, name, kind)

    def _name(self, part: _Part) -> str:
        return printable(part.element(LONGEST_NAME, "a name")[1].decode("utf-8", "replace"), LONGEST_NAME)

    def _leave_out(self, part: _Part, name: str, kind: int) -> None:
        part.skip()
        if name:
            self.others[name] = "an array of structures" if kind == _STRUCT else _OTHERS.get(kind, f"of class {kind}")

    def _fields(self, part: _Part, name: str, depth: int) -> None:
        """Read the fields of a structure."""
        if depth >= DEEPEST:
            raise ValueError(f"structures nested deeper than {DEEPEST}")
        length = part.whole_numbers(1, "the length of names of fields")
        if len(length) != 1 or not 0 < length[0] <= LONGEST_NAME:
            raise ValueError(f"names of fields of {length} bytes")
        _, data = part.element(MOST_MEMBERS * length[0], "names of fields")
        for at in range(0, len(data) // length[0] * length[0], length[0]):
            field = data[at : at + length[0]].partition(b"\0")[0].decode("utf-8", "replace")
            kind, size, content = part.head()
            if kind != _MATRIX or content is not None:
                raise ValueError(f"field {printable(field, 40)} is of type {kind}; want an array")
            if size > part.left:
                raise ValueError(f"a field of {size} bytes where {part.left} are left")
            inner = _Part(part, size, part.order)
            self._matrix(inner, printable(f"{name}.{field}", LONGEST_NAME) if name else "", depth + 1)
            inner.skip()

    def _numbers(self, part: _Part, kind: np.dtype[Any], shape: tuple[int, ...], is_complex: bool) -> NDArray[Any]:
        """Read numbers, the real and, if there is one, the imaginary part."""
        self._limit(shape, kind, is_complex)
        parts = [self._stored(part, kind, math.prod(shape)) for _ in range(1 + is_complex)]
        flat = parts[0] if not is_complex else _complex(*parts)
        return flat.reshape(shape, order="F").squeeze()

    def _limit(self, shape: tuple[int, ...], kind: np.dtype[Any], is_complex: bool) -> None:
        self._bytes += math.prod(shape) * (16 if is_complex else kind.itemsize)
        limit(self._bytes)

    def _stored(self, part: _Part, kind: np.dtype[Any], count: int) -> NDArray[Any]:
        stored, size, content = part.head()
        if stored not in _STORED:
            raise ValueError(f"numbers of type {stored}")
        dtype = np.dtype(part.order + _STORED[stored])
        if size != count * dtype.itemsize:
            raise ValueError(f"{size} bytes of data for {count} numbers of {dtype.itemsize} bytes")
        return np.frombuffer(part.rest(size, content), dtype).astype(kind)

    # --- version 4 ------------------------------------------------------------------------------

    def version_4(self, file: IO[bytes], size: int) -> None:
        """Read the variables of a file of so many bytes."""
        source = _File(file)
        while (begin := file.tell()) < size:
            head = source.take(20)
            order = "<" if 0 <= struct.unpack("<i", head[:4])[0] < 5000 else ">"
            code, rows, columns, imaginary, length = struct.unpack(f"{order}5i", head)
            machine, number, kind = code // 1000, code // 10 % 10, code % 10
            if machine != "<>".index(order) or code // 100 % 10 or number >= len(_STORED_4) or kind > 2:
                raise ValueError(f"a variable of type {code} at {begin}")
            if rows < 0 or columns < 0 or imaginary not in (0, 1) or not 0 < length <= LONGEST_NAME:
                raise ValueError(f"a variable of {rows} rows and {columns} columns at {begin}")
            self._count += 1
            if self._count > MOST_MEMBERS:
                raise ValueError(f"more than {MOST_MEMBERS} arrays")
            name = printable(source.take(length).partition(b"\0")[0].decode("latin-1"), LONGEST_NAME)
            dtype = np.dtype(order + _STORED_4[number])
            bytes_left = size - file.tell()
            stated = rows * columns * dtype.itemsize * (1 + imaginary)
            if stated > bytes_left:
                raise ValueError(f"{name} states {stated} bytes of data where {bytes_left} are left")
            if kind:
                self.others[name] = _OTHERS_4[kind]
                file.seek(stated, os.SEEK_CUR)
                continue
            self._limit((rows, columns), dtype, bool(imaginary))
            flat = np.frombuffer(source.take(stated), dtype).astype(dtype.newbyteorder("="))
            if imaginary:
                flat = _complex(flat[: rows * columns], flat[rows * columns :])
            self.found[name] = flat.reshape((rows, columns), order="F").squeeze()


def _complex(real: NDArray[Any], imaginary: NDArray[Any]) -> NDArray[Any]:
    found = np.empty(len(real), np.complex128)
    found.real, found.imag = real, imaginary
    return found
