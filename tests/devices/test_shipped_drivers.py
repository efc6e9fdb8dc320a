"""Every shipped driver passes ``sioms driver check``."""

from __future__ import annotations

from typing import Any

import pytest
from check_rig import run
from device_rigs import RIGS

from sioms.check.rigs import MAP_RIGS

pytestmark = pytest.mark.timeout(1000)

WIRED = [rig.title for rig in RIGS if rig.line]
BY_MAP = {rig.driver for rig in MAP_RIGS}
SHIPPED = [name for name in WIRED if name not in BY_MAP] + [rig.title for rig in MAP_RIGS]
"""Every driver with a wire; those of register maps by their maps."""
WATCHDOGS = ("dynamixel", "grbl", "odrive", "tmcl")
"""Drivers that set the watchdog of their device, so that it ends a motion without its host."""
REPORTS = "sioms/shipped-drivers"
"""Key of the last reports in pytest's cache."""
NOTHING: dict[str, Any] = {"trials": []}


@pytest.fixture(scope="module")
def shipped(request: pytest.FixtureRequest) -> tuple[dict[str, dict[str, Any]], str]:
    """The drivers that the chosen tests are about, checked side by side.

    In a run of what failed before (``--lf``), only the trials that failed are repeated, the rest has passed.
    """
    names = [
        item.callspec.params["name"] for item in request.session.items if "shipped" in getattr(item, "fixturenames", ())
    ]
    before = request.config.cache.get(REPORTS, {}) if request.config.getoption("lf") else {}
    again = sorted({trial["name"] for name in names for trial in _failed(before.get(name, NOTHING))})
    if "start" in again:  # no trial, but what all of them begin with
        again, before = [], {}
    _, reports, said = run(*names, "-j", "3", *(("--only", ",".join(again)) if again else ()))
    found = {report["driver"]: report for report in reports}
    for name, report in found.items():
        new = {trial["name"]: trial for trial in report["trials"]}
        old = {trial["name"]: trial for trial in before.get(name, NOTHING)["trials"]}
        report["trials"] = list((old | new).values())
    request.config.cache.set(REPORTS, found)
    return found, said


def _failed(report: dict[str, Any]) -> list[dict[str, Any]]:
    return [trial for trial in report["trials"] if trial["verdict"] == "FAILED"]


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_driver_passes(name: str, shipped: tuple[dict[str, dict[str, Any]], str]) -> None:
    reports, said = shipped
    assert name in reports, said
    trials = reports[name]["trials"]
    failed = [f"{t['name']}: expected {t['expected']}; saw {t['seen']}" for t in _failed(reports[name])]
    assert not failed, "\n".join(failed)
    passed = {t["name"] for t in trials if t["verdict"] == "passed"}
    assert {"random", "kill driver", "kill daemon"} <= passed
    assert {"missing", "mute", "unplugged"} <= passed
    if name in WATCHDOGS:
        assert [trial for trial in trials if trial["name"] == "pulled" and "by itself at rest" in trial["seen"]]


@pytest.mark.parametrize("name", ["iio"])
def test_a_driver_without_a_line_passes(name: str, shipped: tuple[dict[str, dict[str, Any]], str]) -> None:
    reports, said = shipped
    verdicts = {t["name"]: t["verdict"] for t in reports[name]["trials"]}
    assert "FAILED" not in verdicts.values(), said
    assert {verdicts[name] for name in ("golden", "timing", "unplugged", "kill driver", "kill daemon")} == {"passed"}
