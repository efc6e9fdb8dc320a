"""What is told: pages, pictures and verdict.json, and the pages of the libraries of effects."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sioms.reconcile.verdict import Verdict


def write_report(verdict: Verdict, folder: Path, seconds: float = 0.0, *, draw: bool = True) -> None:
    """Write ``report.html``, one self-contained page, and ``verdict.json``, all numbers of a verdict on any subject.

    Args:
        folder: is made if need be; files of these names in it are replaced.
        seconds: what the analysis took [s], 0 or more, for page and table.
        draw: whether the page has pictures.

    Raises:
        ImportError: matplotlib is missing (``pip install 'sioms[report]'``).
        OSError: the folder cannot be written to.
    """
    from sioms.reconcile.report.page import page
    from sioms.reconcile.report.words import as_json

    folder.mkdir(parents=True, exist_ok=True)
    page(verdict, seconds, draw=draw).write(folder / "report.html")
    (folder / "verdict.json").write_text(as_json(verdict, seconds))
