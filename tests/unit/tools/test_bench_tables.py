"""Figures become Markdown tables that say what was met."""

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
    assert [line for line in lines if line.startswith("#")] == ["### read", "### axes"]
    ours = next(line for line in lines if line.startswith("| ours [us] |"))
    assert "| 3 | 2 |" in ours and "| 0.2 |" in ours
    assert "p50 ≤ 1.5: **missed**; ratio ≤ 0.25: met" in ours
    assert lines[-1] == "| axes carried |  | 2500 |  |  |  |  |  | value ≥ 2000: met; core 60% |"
    widths = {line.count("|") for line in lines if line.startswith("|")}
    assert widths == {10}
