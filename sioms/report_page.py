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
"""


class Page:
    """Collect the parts of one report in order."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._parts: list[str] = [f"<h1>{html.escape(title)}</h1>"]

    def head(self, text: str) -> None:
        """Add a heading."""
        self._parts.append(f"<h2>{html.escape(text)}</h2>")

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._parts.append(f"<p>{html.escape(text)}</p>")

    def warn(self, text: str) -> None:
        """Add a paragraph that stands out."""
        self._parts.append(f'<p class="warn">{html.escape(text)}</p>')

    def lines(self, lines: Iterable[str]) -> None:
        """Add lines as they are, in a fixed pitch."""
        self._parts.append(f"<pre>{html.escape(chr(10).join(lines))}</pre>")

    def table(self, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """Add a table; a cell that begins with "ok:" or "no:" is coloured."""
        cells = "".join(f"<th>{html.escape(str(name))}</th>" for name in head)
        body = "".join("<tr>" + "".join(_cell(str(value)) for value in row) + "</tr>" for row in rows)
        self._parts.append(f"<table><tr>{cells}</tr>{body}</table>")

    def figure(self, figure: Figure, caption: str) -> None:
        """Add a picture."""
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=110, bbox_inches="tight")
        code = base64.b64encode(buffer.getvalue()).decode()
        alt = html.escape(caption, quote=True)
        self._parts.append(
            f'<figure><img alt="{alt}" src="data:image/png;base64,{code}"><figcaption>{alt}</figcaption></figure>'
        )

    def write(self, path: Path) -> None:
        """Write the page."""
        title = html.escape(self._title)
        path.write_text(
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
            f"<style>{_STYLE}</style></head><body>{''.join(self._parts)}</body></html>\n",
            encoding="utf-8",
        )


def _cell(text: str) -> str:
    for mark, name in (("ok:", "good"), ("no:", "bad")):
        if text.startswith(mark):
            return f'<td class="{name}">{html.escape(text[len(mark) :].strip())}</td>'
    return f"<td>{html.escape(text)}</td>"
