"""Write a report as one self-contained HTML page: text, tables and pictures, nothing fetched from anywhere."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62em; margin: 2em auto; padding: 0 1em; color: #222; }
table { border-collapse: collapse; margin: 1em 0; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid #ccc; padding: .25em .7em; text-align: left; vertical-align: top; }
th { border-bottom: 2px solid #888; }
pre { background: #f4f4f4; padding: .6em; overflow-x: auto; }
figure { margin: 1.5em 0; } img { max-width: 100%; } figcaption { color: #555; }
.good { color: #06662a; } .bad { color: #a01010; } .warn { background: #fff3d0; padding: .4em .8em; }
p.good, p.bad, p.warn { color: inherit; padding: .8em 1em; border-left: 6px solid; } p.good { background: #eef8f3; border-color: #2a7; }
p.bad { background: #fdf2ea; border-color: #c50; } p.warn { border-color: #c90; }
td.number { text-align: right; white-space: nowrap; } .small { font-size: .85em; color: #555; }
"""  # noqa: E501


class Cell(str):
    """A cell of a table that holds numbers: aligned to the right."""


class Page:
    """Collect the parts of one report in order."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._parts: list[str] = [f"<h1>{html.escape(title)}</h1>"]

    def head(self, text: str) -> None:
        """Add a heading."""
        self._parts.append(f"<h2>{html.escape(text)}</h2>")

    def lesser(self, text: str) -> None:
        """Add a heading below a heading."""
        self._parts.append(f"<h3>{html.escape(text)}</h3>")

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._parts.append(f"<p>{html.escape(text)}</p>")

    def small(self, text: str) -> None:
        """Add a paragraph in small print."""
        self._parts.append(f'<p class="small">{html.escape(text)}</p>')

    def box(self, colour: str, lines: Iterable[str]) -> None:
        """Add what is to be read first: a box, "good", "bad" or "warn"."""
        self._parts.append(f'<p class="{colour}">{"<br>".join(map(html.escape, lines))}</p>')

    def items(self, items: Iterable[str]) -> None:
        """Add a list."""
        self._parts.append(f"<ul>{''.join(f'<li>{html.escape(item)}</li>' for item in items)}</ul>")

    def warn(self, text: str) -> None:
        """Add a paragraph that stands out."""
        self._parts.append(f'<p class="warn">{html.escape(text)}</p>')

    def lines(self, lines: Iterable[str]) -> None:
        """Add lines as they are, in a fixed pitch."""
        self._parts.append(f"<pre>{html.escape(chr(10).join(lines))}</pre>")

    def table(self, head: Sequence[str], rows: Iterable[Sequence[object]], folded: str = "") -> None:
        """Add a table; a cell that begins with "ok:" or "no:" is coloured.

        Args:
            folded: words instead of the table, which it shows when they are clicked.
        """
        cells = "".join(f"<th>{html.escape(str(name))}</th>" for name in head)
        body = "".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in rows)
        table = f"<table><tr>{cells}</tr>{body}</table>"
        if folded:
            table = f"<details><summary>{html.escape(folded)}</summary>{table}</details>"
        self._parts.append(table)

    def figure(self, figure: Figure, caption: str = "") -> None:
        """Add a picture."""
        buffer = io.BytesIO()
        cut = None if figure.get_layout_engine() else "tight"  # which draws it twice
        figure.savefig(buffer, format="png", dpi=110, bbox_inches=cut)
        code = base64.b64encode(buffer.getvalue()).decode()
        alt = html.escape(caption, quote=True)
        self._parts.append(
            f'<figure><img alt="{alt}" src="data:image/png;base64,{code}">'
            + (f"<figcaption>{alt}</figcaption></figure>" if caption else "</figure>")
        )

    def write(self, path: Path) -> None:
        """Write the page."""
        title = html.escape(self._title)
        path.write_text(
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
            f"<style>{_STYLE}</style></head><body>{''.join(self._parts)}</body></html>\n",
            encoding="utf-8",
        )


def _cell(value: object) -> str:
    text = str(value)
    if isinstance(value, Cell):
        return f'<td class="number">{html.escape(text)}</td>'
    for mark, name in (("ok:", "good"), ("no:", "bad")):
        if text.startswith(mark):
            return f'<td class="{name}">{html.escape(text[len(mark) :].strip())}</td>'
    return f"<td>{html.escape(text)}</td>"
