"""The report of a check: lines for the terminal, a text file, or a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

from sioms.report_page import Page

from .trial import Result, Verdict

WIDTH = 110


def line_of(result: Result) -> str:
    """Return a result as it is shown on a terminal."""
    return lines_of(result.as_dict())


def lines_of(trial: dict[str, Any]) -> str:
    """Return a trial as lines: its verdict, and for a failed one what was expected, seen, and on the line."""
    verdict = str(trial["verdict"])
    head = f"  {verdict:<7} {trial['name']:<15} {trial['took_s']:6.1f} s  "
    if verdict != Verdict.FAILED.value:
        return fill(head + trial["seen"], WIDTH, subsequent_indent=" " * 36)
    lines = [head + trial["text"]]
    for what in ("expected", "seen"):
        lines.append(fill(f"{what}: {trial[what]}", WIDTH, initial_indent=" " * 10, subsequent_indent=" " * 20))
    if trial["traffic"]:
        lines.append(" " * 10 + "on the line (> to the device, < from it):")
        lines += [" " * 12 + line for line in trial["traffic"]]
    return "\n".join(lines)


def write_report(path: Path, reports: Sequence[dict[str, Any]]) -> None:
    """Write all trials to a file: as a page when its name ends in .html, else as text."""
    if path.suffix == ".html":
        _page(reports).write(path)
        return
    parts = []
    for report in reports:
        parts.append(f"{report['driver']}: {'all trials' if report['full'] else 'quick trials'}")
        parts += [lines_of(trial) for trial in report["trials"]]
    path.write_text("\n".join(parts) + "\n", encoding="utf-8")


_MARKS = {Verdict.PASSED.value: "ok: ", Verdict.FAILED.value: "no: ", Verdict.NOT_APPLICABLE.value: ""}


def _page(reports: Sequence[dict[str, Any]]) -> Page:
    page = Page("Driver check")
    rows = [(r["driver"], *(sum(t["verdict"] == v.value for t in r["trials"]) for v in Verdict)) for r in reports]
    page.table(("driver", *(v.value for v in Verdict)), rows)
    for report in reports:
        page.head(report["driver"])
        rows = [
            (
                _MARKS[t["verdict"]] + t["verdict"],
                t["name"],
                t["text"],
                t["expected"],
                t["seen"],
                f"{t['took_s']:.1f} s",
            )
            for t in report["trials"]
        ]
        page.table(("verdict", "trial", "what was done", "expected", "seen", "took"), rows)
        for trial in report["trials"]:
            if trial["verdict"] == Verdict.FAILED.value and trial["traffic"]:
                page.text(f"On the line at {trial['name']} (> to the device, < from it):")
                page.lines(trial["traffic"])
    return page
