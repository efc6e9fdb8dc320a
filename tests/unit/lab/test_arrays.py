"""Arrays out of files: whatever the bytes, arrays or one sentence."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from sioms.lab import arrays
from sioms.lab.arrays import UnreadableError, read_npz
from sioms.lab.mat import read_mat
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.table import load_table

COLUMNS = {"t": np.arange(20) * 1e-3, "x": np.sin(np.arange(20.0))}


def npz() -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **COLUMNS)
    return file.getvalue()


def mat() -> bytes:
    file = io.BytesIO()
    savemat(file, COLUMNS, do_compression=True)
    return file.getvalue()


def header(shape: tuple[int, ...]) -> bytes:
    """Return an npy file that states a shape and holds hardly any data."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return file.getvalue() + bytes(64)


@pytest.mark.parametrize(("made", "suffix"), [(npz, ".npz"), (mat, ".mat")])
def test_a_good_file_is_read(tmp_path: Path, made: object, suffix: str) -> None:
    path = tmp_path / f"run{suffix}"
    path.write_bytes(made())  # type: ignore[operator]
    for name, column in load_table(path).columns.items():
        np.testing.assert_array_equal(column, COLUMNS[name])


@settings(max_examples=300, deadline=None)
@given(data=st.data(), kind=st.sampled_from([".npz", ".mat"]))
def test_damage_anywhere_is_a_sentence_or_an_array(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, kind: str
) -> None:
    whole = bytearray(npz() if kind == ".npz" else mat())
    for _ in range(data.draw(st.integers(0, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(whole)))
    path = tmp_path_factory.getbasetemp() / f"damaged{kind}"
    path.write_bytes(bytes(whole[:cut]) if data.draw(st.booleans()) else bytes(whole))
    try:
        columns = load_table(path).columns
    except BadInputError as error:
        assert str(path) in str(error) and "\n" not in str(error)
    else:
        assert all(column.ndim == 1 and column.dtype == np.float64 for column in columns.values())


@settings(max_examples=100, deadline=None)
@given(junk=st.binary(max_size=400), kind=st.sampled_from([".npz", ".mat"]))
def test_bytes_of_any_kind_are_a_sentence(tmp_path_factory: pytest.TempPathFactory, junk: bytes, kind: str) -> None:
    path = tmp_path_factory.getbasetemp() / f"junk{kind}"
    path.write_bytes(junk)
    with pytest.raises(BadInputError, match="or is damaged"):
        load_table(path)


@pytest.mark.parametrize("shape", [(1 << 40,), (1 << 31, 1 << 31), (-5,), (10**30,)])
def test_a_shape_that_the_file_cannot_hold_takes_no_memory(tmp_path: Path, shape: tuple[int, ...]) -> None:
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", header(shape))
    with pytest.raises(UnreadableError):
        read_npz(path)


def test_an_archive_that_unpacks_to_too_much_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert arrays.MOST_BYTES == 1 << 30
    most = 1 << 26
    monkeypatch.setattr(arrays, "MOST_BYTES", most)
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("x.npy", "w") as file:
        file.write(header((most // 8 + 8,)))
        for _ in range(most // (1 << 24) + 1):
            file.write(bytes(1 << 24))
    assert path.stat().st_size < most // 300
    with pytest.raises(UnreadableError, match="MiB of memory; at most 64 "):
        read_npz(path)


def test_what_a_mat_file_inflates_to_is_measured_before_it_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One number, as its head says, with 64 MiB of data behind it."""

    def part(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)

    inner = part(6, struct.pack("<II", 6, 0)) + part(5, struct.pack("<ii", 1, 1)) + part(1, b"x")
    squeezed = zlib.compress(part(14, inner + part(9, bytes(1 << 26))))
    (tmp_path / "bomb.mat").write_bytes(
        b"MATLAB 5.0".ljust(124) + b"\0\1IM" + struct.pack("<II", 15, len(squeezed)) + squeezed
    )
    monkeypatch.setattr(arrays, "MOST_BYTES", 1 << 22)
    tracemalloc.start()
    with pytest.raises(UnreadableError, match="MiB of memory; at most 4 "):
        read_mat(tmp_path / "bomb.mat")
    assert tracemalloc.get_traced_memory()[1] < 1 << 21
    tracemalloc.stop()


def test_objects_strings_and_cells_are_no_columns_and_no_code(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=COLUMNS["x"], words=np.array(["a", "b"]), objects=np.array([{}, []], object))
    cells = np.empty(2, dtype=object)
    cells[:] = ["a", np.zeros(3)]
    savemat(tmp_path / "a.mat", {"x": COLUMNS["x"], "words": "text", "cells": cells})
    for name in ("a.npz", "a.mat"):
        assert set(load_table(tmp_path / name).columns) == {"x"}


def test_version_7_3_is_told(tmp_path: Path) -> None:
    path = tmp_path / "new.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(UnreadableError, match=r"version 7\.3, which is HDF5; save it with -v7"):
        read_mat(path)


@pytest.mark.parametrize("text", ["[" * 3000 + "]" * 3000, "a = " + "[" * 3000 + "]" * 3000, "a = " + "9" * 6000])
def test_deep_and_long_model_files_are_sentences(tmp_path: Path, text: str) -> None:
    from sioms.reconcile.files.axis import read_model

    for name in ("model.json", "model.toml"):
        (tmp_path / name).write_text(text)
        with pytest.raises(BadInputError, match="read model"):
            read_model(tmp_path / name)
