"""What lists something lists it as JSON, too."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from recording_rig import OFFSET_NS, START_NS, write
from tool_rig import parsers

from sioms.client.keys import Folder
from sioms.tools.front import main

LISTS = {"list", "info", "status", "alarms", "blackbox"}
"""Commands and actions that list."""


def test_every_command_that_lists_does_so_as_json() -> None:
    listing = {words: parser for words, parser in parsers().items() if words.split()[-1] in LISTS}
    assert {"list", "key list", "cert list", "driver list", "log info", "alarms", "blackbox", "info"} <= set(listing)
    lacking = [words for words, parser in listing.items() if "--json" not in parser._option_string_actions]
    assert not lacking


def printed(capsys: pytest.CaptureFixture[str], *words: object) -> Any:
    assert main([str(word) for word in words]) == 0
    return json.loads(capsys.readouterr().out)


def test_recordings(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", 40)
    found = printed(capsys, "log", "info", "--json", path)
    assert found["bytes"] == path.stat().st_size and not found["packed"] and found["damage"] == []
    assert [node["name"] for node in found["nodes"]] == ["mod0", "force0", "io0.in"]
    assert found["nodes"][0]["snapshots"] == 40 and found["nodes"][0]["channels"][2] == {"name": "c", "unit": "rad"}
    assert found["begin_ns"] >= START_NS + OFFSET_NS and found["event_count"] == 5 and "events" not in found
    assert len(printed(capsys, "log", "info", "--json", "-e", path)["events"]) == 5
    assert len(printed(capsys, "blackbox", "--json", "-a", path)["events"]) == 5


def test_keys(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    where = ("--keys", tmp_path / "keys")
    assert printed(capsys, "key", "list", "--json", *where) == {"own": None, "allowed": [], "trusted": []}
    folder = Folder(str(tmp_path / "keys"))
    pair = folder.new("eva")
    folder.allow("ben", "x" * 40, ("ops",))
    folder.trust("lab2:5770", "y" * 40)
    text = json.dumps(found := printed(capsys, "key", "list", "--json", *where))
    assert found["own"] == {"name": "eva", "public": pair.public} and pair.secret not in text
    assert found["allowed"] == [{"name": "ben", "public": "x" * 40, "groups": ["ops"]}]
    assert found["trusted"] == [{"gateway": "lab2:5770", "public": "y" * 40}]


def test_certificates_and_drivers(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    pytest.importorskip("cryptography")
    where = ("--keys", tmp_path / "keys")
    assert printed(capsys, "cert", "list", "--json", *where) == {"own": None, "signed": []}
    assert {"sim-axes", "gantry"} <= {row["driver"] for row in printed(capsys, "driver", "list", "--json")}
