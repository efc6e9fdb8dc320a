"""The table of rigs, and what a driver's own says."""

from __future__ import annotations

import tomllib
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import pytest

from sioms.bench.drivers import CASES, STREAMS, Case, faster
from sioms.check import command
from sioms.check.check import Subject
from sioms.check.rigs import MAP_RIGS, RIGS, Axis, Rig, find_rig, rig_of

KEYS = {
    "driver": "scale.py",
    "tables": '[device.scale]\ndriver = "{driver}"\nline = { serial = "{port}", baud = 9600, parity = "E", stop_bits = '
    "2 }\n",
    "simulator": ["scale_device.py", "--fast"],
    "axes": [{"node": "scale.x", "reach": 0.5}],
}


def test_a_driver_names_its_rig() -> None:
    rig = rig_of(KEYS)
    assert (rig.device, rig.line, rig.setting("baud", 0), rig.bits_per_character) == (
        "scale",
        "serial",
        9600,
        12,
    )
    assert rig.axes == (Axis("scale.x", 0.5),) and tuple(rig.simulator) == ("scale_device.py", "--fast")
    assert rig.table["line"] == {"serial": "/dev/null", "baud": 9600, "parity": "E", "stop_bits": 2}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"simulators": []}, "unknown key simulators; want one of driver, tables"),
        ({"tcp": "yes"}, "tcp"),
        ({"axes": [{}]}, "node"),
    ],
)
def test_a_wrong_rig_is_a_sentence(change: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        rig_of({**KEYS, **change})


@pytest.mark.parametrize("rig", [*RIGS, *MAP_RIGS], ids=lambda rig: rig.title)
def test_every_rig_is_whole(rig: Rig) -> None:
    tables = tomllib.loads(rig.configured("/dev/x" if rig.line == "serial" else "127.0.0.1:1", "127.0.0.1:2"))
    assert next(iter(tables["device"])) == rig.device and tables["device"][rig.device]["driver"] == rig.driver
    assert find_rig(rig.title) is rig
    if rig.line:
        assert rig.simulator


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.rig} {case.baud}")
def test_the_bench_finds_its_drivers_and_makes_them_faster(case: Case) -> None:
    rig = find_rig(case.rig)
    assert rig is not None
    device = tomllib.loads(faster(rig, case.baud, case.poll_hz).configured("/dev/x", ""))["device"][rig.device]
    assert device["line"]["baud"] == case.baud and device["poll_hz"] == case.poll_hz


def test_the_streams_of_the_bench_are_there() -> None:
    assert all(find_rig(name) is not None for name, _ in STREAMS)


@pytest.mark.parametrize("name", ["gpio", "iio-dummy"])
def test_a_kernel_that_does_not_simulate_the_device_is_told_apart_from_a_failed_check(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rig, checked = find_rig(name), list[str]()
    assert rig is not None and rig.kernel.startswith("/sys/kernel/config/")
    asked = Namespace(all=False, drivers=[name], only="", simulator="", config=None, full=False, json=None, report=None)

    def check(subject: Subject, **_: object) -> list[object]:
        checked.append(subject.rig.title)
        return []

    monkeypatch.setattr(command, "check", check)
    for place, status in ((tmp_path / "none", command.USAGE), (tmp_path, 0)):
        monkeypatch.setattr(command, "find_rig", lambda _, at=place: replace(rig, kernel=str(at)))
        assert command.run_check(asked) == status
    assert checked == [name]
    assert f"simulated by the kernel, and this one has no {tmp_path / 'none'}" in capsys.readouterr().err
