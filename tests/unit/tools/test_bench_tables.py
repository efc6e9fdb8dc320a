"""Figures become Markdown tables that say what was met."""

import json
from pathlib import Path

import numpy as np

from sioms.bench.figures import Bar, Report
from sioms.bench.tables import markdown


def test_each_sub_bench_is_a_table_with_its_verdicts(capsys: object) -> None:
    report = Report()
    report.begin("read", "reads")
    base = report.samples("bare", [10_000] * 3)
    report.samples("ours", [1_000, 2_000, 4_000], baseline=base, bars=[Bar("p50", 1.5), Bar("ratio", 0.25)])
    report.begin("axes", "axes")
    report.value("axes carried", 2500, bars=[Bar("value", 2000, True)], notes="core 60%")
    lines = markdown(report.figures).splitlines()
    assert [line for line in lines if line.startswith("#")] == ["### Targets", "### read", "### axes"]
    assert lines[4:7] == [
        "| `read` | ours [us] | p50 2 | ≤ 1.5 | **missed** |",
        "| `read` | ours [us] | ratio 0.2 | ≤ 0.25 | met |",
        "| `axes` | axes carried | 2500 | ≥ 2000 | met |",
    ]
    ours = next(line for line in lines if line.startswith("| ours [us] |"))
    assert "| 3 | 2 |" in ours and "| 0.2 |" in ours
    assert "p50 ≤ 1.5: **missed**; ratio ≤ 0.25: met" in ours
    assert lines[-1] == "| axes carried |  | 2500 |  |  |  |  |  | value ≥ 2000: met; core 60% |"
    widths = {line.count("|") for line in lines[lines.index("### read") :] if line.startswith("|")}
    assert widths == {10}


def test_a_run_is_a_line_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "runs"
    for seed in (1, 2):
        report = Report()
        report.begin("deaths", "deaths")
        report.samples("halt", [3_000_000, 30_000_000], "ms", bars=[Bar("max", 20.0)])
        report.value("stops lost", 0, bars=[Bar("value", 0)])
        report.note("late")
        report.append(str(path), seed=seed)
    first, second = map(json.loads, path.read_text().splitlines())
    assert (first["seed"], second["seed"]) == (1, 2)
    assert first["missed"] == ["deaths: halt"] and first["notes"] == ["late"]
    assert first["figures"]["deaths: stops lost"] == 0 and first["figures"]["deaths: halt"]["max"] == 30.0


def test_numbers_of_numpy_are_written_like_others(tmp_path: Path) -> None:
    report = Report()
    report.begin("hand", "hand")
    report.samples("angle", list(np.array([1, 2], dtype=np.int64)), "deg", bars=[Bar("max", 3.0)])
    report.value("share", np.float32(50.0), bars=[Bar("value", 40.0, True)])  # type: ignore[arg-type]
    report.write(str(tmp_path / "a.json"))
    one, two = json.loads((tmp_path / "a.json").read_text())["figures"]
    assert one["percentiles"]["max"] == 2 and one["bars"][0]["met"] is True
    assert two["value"] == 50.0 and two["bars"][0]["met"] is True
