"""Drivers are found as the standard library finds them, without loading it."""

import json
import subprocess
import sys
from importlib import metadata

import pytest

from sioms.sdk import registry
from sioms.sdk.finding import GROUP


@pytest.mark.parametrize("group", [GROUP, "console_scripts", "pytest11", "nothing"])
def test_the_entry_points_are_those_of_the_standard_library(group):
    wanted = {point.name: point.value for point in metadata.entry_points(group=group)}
    assert {point.name: point.value for point in registry.entry_points(group).values()} == wanted
    assert wanted or group == "nothing"


def test_what_is_installed_twice_counts_once_and_odd_lines_do_not(tmp_path, monkeypatch):
    def install(place, folder, text):
        (tmp_path / place / folder).mkdir(parents=True)
        (tmp_path / place / folder / "entry_points.txt").write_text(text)

    install(
        "a", "Mine-1.0.dist-info", "[other]\nx = no:no\n\n[ours]\n# y = no:no\nx = json:decoder.JSONDecoder\nbare\n"
    )
    install("b", "mine-0.9.dist-info", "[ours]\nx = json:gone\nz = json:gone\n")
    install("b", "more.egg-info", "[ours]\nm = json\nbad = json:gone.deeper [extra]\n")
    (tmp_path / "c.zip").write_bytes(b"")
    monkeypatch.setattr(sys, "path", [str(tmp_path / "a"), str(tmp_path / "b"), str(tmp_path / "c.zip"), "/nowhere"])
    found = registry.entry_points("ours")
    assert sorted(found) == ["bad", "m", "x"]
    assert found["x"].load() is json.decoder.JSONDecoder and found["m"].load() is json
    with pytest.raises(AttributeError):
        found["bad"].load()


def test_a_fork_server_loads_nothing_for_mail_archives_and_tables():
    code = "import sys, sioms.sdk.fork_server as f, sioms.sdk.process; "
    code += "[f.find_driver(name, '/') for name in ('sim-axes', 'sim-io')]; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    needless = {"importlib.metadata", "email.message", "zipfile", "csv", "asyncio"}
    assert not needless & set(done.stdout.split())
