"""MAT files: what another author's reader finds in sound ones, and arrays or one sentence of any others."""

from __future__ import annotations

import io
import random
import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from scipy.io import loadmat, savemat

from sioms.lab import mat
from sioms.lab.arrays import UnreadableError
from sioms.lab.mat import read_mat
from sioms.reconcile.files.table import load_table

WRITTEN_BY_MATLAB = sorted((Path(scipy.io.__file__).parent / "matlab/tests/data").glob("*.mat"))
NO_NUMBERS = ("cell", "char", "string", "sparse", "structarr", "testfunc", "object", "unicode", "parabola", "sqr")
DAMAGED = ("bad_", "broken", "corrupted", "debigged", "malformed", "hdf5", "nasty", "test_empty", "broken_utf8")
COLUMNS = {"t": np.arange(20) * 1e-3, "x": np.sin(np.arange(20.0))}


def numbers(value: Any, name: str, found: dict[str, Any]) -> dict[str, Any]:
    """Return the arrays of numbers that scipy has found, those of structures by their path."""
    if isinstance(value, dict):
        for key, each in value.items():
            if not key.startswith("__"):
                numbers(each, f"{name}.{key}" if name else key, found)
    elif np.asarray(value).dtype.kind in "fiubc":
        found[name] = np.asarray(value)
    return found


@pytest.mark.parametrize("path", WRITTEN_BY_MATLAB, ids=lambda path: path.name)
def test_files_of_matlab_hold_what_scipy_reads(path: Path) -> None:
    if path.name.startswith(DAMAGED) or "hdf5" in path.name:
        pytest.skip("damaged on purpose, or of version 7.3")
    if any(word in path.name for word in NO_NUMBERS):
        with pytest.raises(UnreadableError, match=r"holds no arrays of numbers: .* is "):
            read_mat(path)
        return
    ours, theirs = read_mat(path), numbers(loadmat(path, simplify_cells=True), "", {})
    assert list(ours) == list(theirs)
    for name, array in theirs.items():
        np.testing.assert_array_equal(ours[name], array)


def test_there_were_such_files() -> None:
    assert len(WRITTEN_BY_MATLAB) > 90


kinds = st.sampled_from(["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "c16"])
values = kinds.flatmap(lambda kind: arrays(np.dtype(kind), array_shapes(min_dims=1, max_dims=4, max_side=4)))
variables = st.dictionaries(
    st.from_regex(r"[a-z][a-z0-9]{0,9}", fullmatch=True),
    st.one_of(values, st.dictionaries(st.sampled_from(["a", "b"]), values, min_size=1)),
    min_size=1, max_size=3,
)  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(given_=variables, compressed=st.booleans())
def test_what_was_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, given_: dict[str, Any], compressed: bool
) -> None:
    path = tmp_path_factory.getbasetemp() / "written.mat"
    savemat(path, given_, do_compression=compressed)
    ours, theirs = read_mat(path), numbers(loadmat(path, simplify_cells=True), "", {})
    assert set(ours) == set(theirs)
    for name, array in theirs.items():
        np.testing.assert_array_equal(ours[name], array)
        assert ours[name].dtype == array.dtype or not array.ndim  # of one number scipy makes one of Python


def test_structures_are_columns(tmp_path: Path) -> None:
    cells = np.empty(2, dtype=object)
    cells[:] = [np.zeros(3), "text"]
    savemat(tmp_path / "a.mat", {"run": {**COLUMNS, "deep": {"f": np.ones(4)}, "note": "cold", "c": cells}})
    columns = load_table(tmp_path / "a.mat").columns
    assert list(columns) == ["run.t", "run.x", "run.deep.f"]
    np.testing.assert_array_equal(columns["run.x"], COLUMNS["x"])
    savemat(tmp_path / "b.mat", {"cells": cells, "note": "cold"})
    with pytest.raises(UnreadableError, match="no arrays of numbers: cells is a cell array, note is text"):
        read_mat(tmp_path / "b.mat")


def whole(kind: str) -> bytes:
    """Return a sound file."""
    file = io.BytesIO()
    cells = np.empty(2, dtype=object)
    cells[:] = [np.zeros(3), "text"]
    nested = {"run": {**COLUMNS, "deep": {"f": np.ones(4)}}, "c": cells, "z": np.ones(3) * 1j, "i": np.int8([1, 2])}
    match kind:
        case "4":
            savemat(file, {**COLUMNS, "m": np.eye(3, dtype="i2"), "s": "text"}, format="4")
        case "plain":
            savemat(file, nested)
        case "compressed":
            savemat(file, nested, do_compression=True)
        case name:
            return (WRITTEN_BY_MATLAB[0].parent / name).read_bytes()
    return file.getvalue()


SOUND = ["4", "plain", "compressed", "big_endian.mat", "testdouble_4.2c_SOL2.mat", "teststructnest_7.4_GLNX86.mat"]


@pytest.mark.parametrize("kind", SOUND)
def test_damage_anywhere_gives_arrays_or_one_sentence_and_little_memory(tmp_path: Path, kind: str) -> None:
    sound, chance, path = whole(kind), random.Random(kind), tmp_path / "damaged.mat"
    for _ in range(120):
        data = bytearray(sound)
        for _ in range(chance.randint(1, 4)):
            at = chance.randrange(len(data))
            data[at : at + chance.choice((1, 1, 4))] = chance.choice((b"\0", b"\xff" * 4, chance.randbytes(4)))
        path.write_bytes(data[: chance.choice((len(data), chance.randrange(len(data) + 1)))])
        try:
            found = read_mat(path)
        except UnreadableError as error:
            assert "\n" not in str(error) and str(path) in str(error) and str(error).isprintable()
        else:
            assert all(array.dtype.kind in "fiuc" and name.isprintable() for name, array in found.items())


def element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def head(shape: tuple[int, ...], kind: int = 6) -> bytes:
    """Return what stands before the data of an array."""
    sizes = struct.pack(f"<{len(shape)}i", *shape)
    return element(6, struct.pack("<II", kind, 0)) + element(5, sizes) + element(1, b"x")


@pytest.mark.parametrize(
    ("inner", "why"),
    [
        (head((2**31 - 1, 2**31 - 1)) + element(9, bytes(8)), "MiB of memory"),
        (head((2**27, 1)) + element(9, bytes(8)), "8 bytes of data for 134217728 numbers"),
        (head((2**30, 1)) + element(2, bytes(8)), "MiB of memory"),
        (head((-1, 3)) + element(9, bytes(8)), r"shape \(-1, 3\)"),
        (head((1,) * 40) + element(9, bytes(8)), "a shape of 160 bytes"),
        (head((1, 1)) + struct.pack("<II", 9, 1 << 30), "bytes of data for 1 numbers"),
        (head((1, 1)) + element(99, bytes(8)), "numbers of type 99"),
        (head((1, 1), 2) + element(5, struct.pack("<i", -7)) + element(1, b"a" * 32), "names of fields"),
        (head((1, 1), 2) + element(5, struct.pack("<i", 1)) + struct.pack("<II", 1, 1 << 30), "names of fields of"),
        (element(6, bytes(4)), "without flags"),
        (struct.pack("<II", 0x00070006, 0), "a small element of 7 bytes"),
    ],
)
@pytest.mark.parametrize("compressed", [False, True])
def test_sizes_and_shapes_are_looked_at_before_memory_is_given(
    tmp_path: Path, inner: bytes, why: str, compressed: bool
) -> None:
    packed = zlib.compress(element(14, inner))
    whole = struct.pack("<II", 15, len(packed)) + packed if compressed else element(14, inner)
    path = tmp_path / "bomb.mat"
    path.write_bytes(b"MATLAB 5.0".ljust(124) + b"\0\1IM" + whole)
    tracemalloc.start()
    with pytest.raises(UnreadableError, match=why):
        read_mat(path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()


def test_structures_are_bounded_in_depth_and_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deep: Any = np.ones(2)
    for _ in range(mat.DEEPEST + 1):
        deep = {"a": deep}
    savemat(tmp_path / "deep.mat", {"x": deep})
    with pytest.raises(UnreadableError, match="nested deeper than 8"):
        read_mat(tmp_path / "deep.mat")
    monkeypatch.setattr(mat, "MOST_MEMBERS", 3)
    for name in ("4", "5"):
        savemat(tmp_path / "many.mat", {f"x{i}": np.ones(2) for i in range(5)}, format=name)
        with pytest.raises(UnreadableError, match="more than 3 arrays"):
            read_mat(tmp_path / "many.mat")


@pytest.mark.parametrize("spoilt", ["sum", "more", "short"])
def test_a_compressed_variable_must_end_where_it_says(tmp_path: Path, spoilt: str) -> None:
    inner = element(14, head((1, 1)) + element(9, bytes(8)))
    packed = bytearray(zlib.compress(inner + bytes(8) * (spoilt == "more")))
    if spoilt == "sum":
        packed[-1] ^= 1
    if spoilt == "short":
        del packed[-3:]
    (tmp_path / "a.mat").write_bytes(
        b"MATLAB 5.0".ljust(124) + b"\0\1IM" + struct.pack("<II", 15, len(packed)) + packed
    )
    with pytest.raises(UnreadableError, match=r"incorrect data check|does not end where it says"):
        read_mat(tmp_path / "a.mat")
