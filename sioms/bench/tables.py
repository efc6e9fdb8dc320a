"""Figures as Markdown tables, one a sub-bench, as docs/bench.md shows them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby

from .figures import PERCENTILES, Bar, Figure


def markdown(figures: Sequence[Figure]) -> str:
    """Return a table of all targets, then a heading and a table for each sub-bench, in the order in which they ran."""
    tables = [_table(bench, list(group)) for bench, group in groupby(figures, lambda f: f.bench)]
    return "\n".join([*_targets(figures), *tables])


def _targets(figures: Sequence[Figure]) -> list[str]:
    rows = [
        _row([f"`{each.bench}`", each.name + _unit(each), f"{bar.statistic} {_number(found)}".removeprefix("value "),
              _limit(bar), "met" if met else "**missed**"])
        for each in figures for bar, found, met in each.verdicts()
    ]  # fmt: skip
    head = [_row(["sub-bench", "figure", "found", "target", ""]), _row(["---"] * 5)]
    return ["### Targets", "", *head, *rows, ""] if rows else []


def _unit(figure: Figure) -> str:
    return f" [{figure.unit}]" if figure.unit else ""


def _limit(bar: Bar) -> str:
    return f"{'≥' if bar.at_least else '≤'} {bar.limit:g}"


def _table(bench: str, figures: list[Figure]) -> str:
    names = [name for name, _ in PERCENTILES]
    lines = [
        f"### {bench}",
        "",
        _row(["figure", "count", *names, "ratio", "bars"]),
        _row(["---"] * (len(names) + 4)),
    ]
    return "\n".join([*lines, *map(_line, figures), ""])


def _line(figure: Figure) -> str:
    if figure.summary is not None:
        cells = [
            str(figure.summary.count),
            *(_number(figure.summary.values[name]) for name, _ in PERCENTILES),
        ]
    else:
        cells = ["", _number(figure.value or 0.0), *[""] * (len(PERCENTILES) - 1)]
    ratio = f"{figure.ratio:.3g}" if figure.ratio is not None else ""
    notes = [figure.notes] if figure.notes else []
    return _row([figure.name + _unit(figure), *cells, ratio, "; ".join([*_bars(figure), *notes])])


def _bars(figure: Figure) -> Iterable[str]:
    for bar, _, met in figure.verdicts():
        yield f"{bar.statistic} {_limit(bar)}: {'met' if met else '**missed**'}"


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000 or value == int(value) else f"{value:.3g}"


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
