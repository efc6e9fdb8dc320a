"""The contents of a file that a person wrote; whatever is wrong with it becomes bad input."""

from __future__ import annotations

from pathlib import Path

from sioms.documents import read_bytes
from sioms.reconcile.errors import BadInputError


def contents(path: Path, where: str) -> bytes:
    """Read a file.

    Args:
        where: begins a message, "read model nominal.toml".

    Raises:
        BadInputError: there is none, it is a folder, it cannot be read, or it is too large.
    """
    if not path.exists():
        raise BadInputError(f"{where}: no such file")
    try:
        return read_bytes(path)
    except OSError as e:
        raise BadInputError(f"{where}: {e.strerror or e}; needs a file that can be read") from e
    except ValueError as e:
        raise BadInputError(f"{where}: {e}") from e
