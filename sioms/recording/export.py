"""Tables as files that other programs read: CSV, NPZ and Parquet."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FORMATS = (".csv", ".npz", ".parquet")


def export(
    columns: Mapping[str, NDArray[Any]],
    path: Path,
    utc_ns: NDArray[np.int64] | None = None,
    about: Mapping[str, str] | None = None,
) -> None:
    """Write a table: CSV, NPZ or Parquet, by the ending of the name.

    Args:
        columns: by their heads, units in brackets; the first is a time [s].
        path: what is written.
        utc_ns: times by UTC [ns], for Parquet alone: a column ``utc`` of time stamps.
        about: of Parquet files, metadata ``sioms``, as JSON.

    Raises:
        OSError: it cannot be written, or EINVAL, an ending that is none of these.
        ModuleNotFoundError: pyarrow is not installed, for Parquet.
    """
    match path.suffix:
        case ".csv":
            _csv(columns, path)
        case ".npz":
            np.savez_compressed(path, **columns)  # type: ignore[arg-type]
        case ".parquet":
            _parquet(columns, path, utc_ns, about or {})
        case _:
            raise OSError(22, f"export to {path}: want a name that ends in {', '.join(FORMATS)}")


def _csv(columns: Mapping[str, NDArray[Any]], path: Path) -> None:
    with open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        time, *others = columns.values()
        stamps = [f"{value:.9f}" for value in time.tolist()]
        writer.writerows(zip(stamps, *[values.tolist() for values in others], strict=True))


def _parquet(
    columns: Mapping[str, NDArray[Any]], path: Path, utc_ns: NDArray[np.int64] | None, about: Mapping[str, str]
) -> None:
    import pyarrow
    from pyarrow import parquet

    fields, arrays = [], []
    if utc_ns is not None:
        fields.append(pyarrow.field("utc", pyarrow.timestamp("ns", "UTC")))
        arrays.append(pyarrow.array(utc_ns, pyarrow.timestamp("ns", "UTC")))
    for head, values in columns.items():
        array = pyarrow.array(values.tolist() if values.dtype.kind == "U" else np.ascontiguousarray(values))
        unit = re.search(r" \[([^]]*)\]$", head)
        fields.append(pyarrow.field(head, array.type, metadata={"unit": unit[1]} if unit else None))
        arrays.append(array)
    schema = pyarrow.schema(fields, metadata={"sioms": json.dumps(dict(about))})
    parquet.write_table(pyarrow.Table.from_arrays(arrays, schema=schema), path, compression="zstd")
