"""Files that people keep: written as a whole, or not at all."""

from __future__ import annotations

import os
from pathlib import Path


def write_whole(path: Path, text: str) -> None:
    """Write a text file in one step; a full disk or a death leaves what was there before.

    Args:
        path: of the file; a link is followed, and what is no ordinary file is written to.
        text: what shall be in it.

    Raises:
        OSError: it could not be written, with a sentence that names it.
    """
    target = path.resolve()
    fresh = target.with_name(f".{target.name}-{os.getpid()}")
    try:
        if target.exists() and not target.is_file():
            target.write_text(text, encoding="utf-8")
            return
        try:
            with open(fresh, "w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            if target.exists():
                fresh.chmod(target.stat().st_mode & 0o7777)
            fresh.replace(target)
        finally:
            fresh.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, f"write {path}: {os.strerror(error.errno or 0).lower()}") from None
