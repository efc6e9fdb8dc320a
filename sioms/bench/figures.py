"""Figures: samples in, percentiles, ratios, bars, tables and JSON out.

Conventions: durations are collected in integer nanoseconds and shown in microseconds or
milliseconds. A ratio is that of medians, ours over the baseline's, unless the bar says otherwise.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

PERCENTILES = (("p50", 0.5), ("p90", 0.9), ("p99", 0.99), ("p99.9", 0.999), ("max", 1.0))
UNITS = {"us": 1e-3, "ms": 1e-6, "s": 1e-9, "": 1.0}


@dataclass(frozen=True, slots=True)
class Summary:
    """Percentiles of samples.

    Attributes:
        count: number of samples.
        values: by the names of PERCENTILES, in the figure's unit.
    """

    count: int
    values: Mapping[str, float]

    @classmethod
    def of(cls, samples: Sequence[float], unit: str) -> Summary:
        """Summarise samples (nanoseconds when the unit is one of time).

        Raises:
            ValueError: there are none.
        """
        if not samples:
            raise ValueError("summarise samples: there are none; want at least one")
        ordered = sorted(samples)
        last = len(ordered) - 1
        scale = UNITS.get(unit, 1.0)
        return cls(len(ordered), {n: float(ordered[min(last, int(p * len(ordered)))] * scale) for n, p in PERCENTILES})


@dataclass(frozen=True, slots=True)
class Bar:
    """What a figure should reach.

    Attributes:
        statistic: a percentile's name, ``value``, or ``ratio`` (medians, to the baseline).
        limit: in the figure's unit.
        at_least: whether more is better.
        source: what the bar is, in words.
    """

    statistic: str
    limit: float
    at_least: bool = False
    source: str = ""

    def met(self, found: float) -> bool:
        """Tell whether a figure reaches it."""
        return bool(found >= self.limit if self.at_least else found <= self.limit)  # of numpy's, too


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured thing.

    Attributes:
        bench, name, unit: what it is.
        summary: percentiles, or None for a single ``value``.
        value: the single number.
        baseline: name of what it is compared with; ``ratio`` is ours over the baseline's median.
        cpu: share of one core by process, during the measurement.
        bars: what it should reach.
        notes: further facts.
    """

    bench: str
    name: str
    unit: str
    summary: Summary | None = None
    value: float | None = None
    baseline: str = ""
    ratio: float | None = None
    cpu: Mapping[str, float] = field(default_factory=dict)
    bars: tuple[Bar, ...] = ()
    notes: str = ""

    def statistic(self, name: str) -> float | None:
        """Return a percentile, the value or the ratio; None when there is none."""
        if name == "ratio":
            return self.ratio
        if name == "value":
            return self.value
        return self.summary.values[name] if self.summary is not None else None

    def verdicts(self) -> list[tuple[Bar, float, bool]]:
        """Return each bar with what was found and whether it was reached."""
        found = [(bar, self.statistic(bar.statistic)) for bar in self.bars]
        return [(bar, value, bar.met(value)) for bar, value in found if value is not None]


class Report:
    """Collects figures, prints each as it comes, and a table of all bars at the end.

    Attributes:
        figures: all of them, in order.
    """

    def __init__(self) -> None:
        self.figures: list[Figure] = []
        self.notes: list[str] = []
        self._bench = ""
        self._said = 0.0
        self._load_before = os.getloadavg()[0]

    def begin(self, bench: str, text: str) -> None:
        """Head the figures of a sub-bench."""
        self._bench = bench
        print(f"\n{bench}: {text}")
        head = " ".join(f"{name:>9}" for name, _ in PERCENTILES)
        print(f"  {'':54} {'count':>8} {head}")

    def samples(
        self, name: str, samples: Sequence[float], unit: str = "us", *, baseline: Figure | None = None,
        cpu: Mapping[str, float] | None = None, bars: Sequence[Bar] = (), notes: str = "",
    ) -> Figure:  # fmt: skip
        """Add a figure with percentiles of samples [ns for units of time]."""
        summary = Summary.of(samples, unit)
        ratio = None
        if baseline is not None and baseline.summary is not None:
            scale = UNITS[unit] / UNITS[baseline.unit]
            base = baseline.summary.values["p50"] * scale
            ratio = summary.values["p50"] / base if base else None
        other = baseline.name if baseline is not None else ""
        figure = Figure(
            self._bench, name, unit, summary, None, other, ratio, cpu or {}, tuple(bars), notes
        )  # fmt: skip
        return self._add(figure)

    def value(
        self, name: str, value: float, unit: str = "", *, cpu: Mapping[str, float] | None = None,
        bars: Sequence[Bar] = (), notes: str = "",
    ) -> Figure:  # fmt: skip
        """Add a figure of one number."""
        return self._add(
            Figure(self._bench, name, unit, value=float(value), cpu=cpu or {}, bars=tuple(bars), notes=notes)
        )

    def note(self, text: str) -> None:
        """Print a line between the figures."""
        self.notes.append(text)
        print(f"  {text}")

    def progress(self, text: str) -> None:
        """Tell how far a long measurement is, at most twice a second and only to a terminal."""
        now = time.monotonic()
        if sys.stderr.isatty() and now - self._said > 0.5:
            self._said = now
            print(f"\r  {text:76}\r", end="", file=sys.stderr, flush=True)

    def summary(self) -> None:
        """Print which bars were reached."""
        rows = [(figure, *verdict) for figure in self.figures for verdict in figure.verdicts()]
        if not rows:
            return
        print("\nbars")
        for figure, bar, found, met in rows:
            sign, unit = (">=", "<=")[not bar.at_least], "" if bar.statistic == "ratio" else f" {figure.unit}"
            against = f" of {figure.baseline}" if bar.statistic == "ratio" else ""
            wanted = f"{bar.statistic} {sign} {bar.limit:g}{unit}{against}"
            print(
                f"  {'met   ' if met else 'MISSED'} {figure.bench:9} {figure.name:48.48} {found:10.4g}{unit:4} {wanted}"
            )
        print(f"  {sum(row[3] for row in rows)} of {len(rows)} met; {self._machine()}")

    def write(self, path: str, **facts: object) -> None:
        """Write everything as JSON."""
        figures = [
            {
                "bench": f.bench,
                "name": f.name,
                "unit": f.unit,
                "value": f.value,
                "baseline": f.baseline,
                "ratio": f.ratio,
                "count": f.summary.count if f.summary else None,
                "percentiles": dict(f.summary.values) if f.summary else None,
                "cpu_share": dict(f.cpu),
                "notes": f.notes,
                "bars": [
                    {
                        "statistic": bar.statistic,
                        "limit": bar.limit,
                        "at_least": bar.at_least,
                        "found": found,
                        "met": met,
                        "source": bar.source,
                    }
                    for bar, found, met in f.verdicts()
                ],
            }
            for f in self.figures
        ]
        with open(path, "w", encoding="utf-8") as file:
            json.dump({"machine": self._machine(), **facts, "figures": figures}, file, indent=1)
            file.write("\n")

    def append(self, path: str, **facts: object) -> None:
        """Append what has been measured to a file, as one line of JSON: a long measurement is a file of short ones.

        Args:
            path: of the file.
            facts: further keys.
        """
        figures = {
            f"{f.bench}: {f.name}": f.value if f.summary is None else {"count": f.summary.count, **f.summary.values}
            for f in self.figures
        }
        missed = [f"{f.bench}: {f.name}" for f in self.figures if not all(met for _, _, met in f.verdicts())]
        line = {"machine": self._machine(), **facts, "figures": figures, "missed": missed, "notes": self.notes}
        with open(path, "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def _add(self, figure: Figure) -> Figure:
        self.figures.append(figure)
        name = f"{figure.name} [{figure.unit}]" if figure.unit else figure.name
        if figure.summary is not None:
            values = " ".join(f"{figure.summary.values[n]:9.4g}" for n, _ in PERCENTILES)
            line = f"  {name:54} {figure.summary.count:8} {values}"
        else:
            line = f"  {name:54} {figure.value:8.5g}"
        if figure.ratio is not None:
            line += f"  {figure.ratio:.3g} x {figure.baseline}"
        if figure.cpu:
            line += "  cpu " + " ".join(f"{who} {share:.0%}" for who, share in figure.cpu.items())
        if figure.notes:
            line += f"  ({figure.notes})"
        print(line, flush=True)
        return figure

    def _machine(self) -> str:
        cores = len(os.sched_getaffinity(0))
        load = f"load {self._load_before:.1f} before and {os.getloadavg()[0]:.1f} after"
        return (
            f"{cores} cores, {platform.machine()}, {platform.system()} {platform.release()}, Python "
            f"{platform.python_version()}, {load}"
        )
