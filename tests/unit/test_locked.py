"""The locked packages: all that pyproject.toml asks for, with hashes, the same everywhere, and what is installed
here.
"""

from __future__ import annotations

import importlib.metadata
import re
import tomllib
from collections import defaultdict
from pathlib import Path

import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

TREE = Path(__file__).resolve().parents[2]
PROFILES = {
    "service": ["gpio"],
    "run": ["fast", "gpio", "report"],
    "test": ["fast", "gpio", "report", "test"],
}
AGAIN = "run ./dev lock"
Pins = dict[str, list[tuple[Version, Marker | None, int]]]


def pinned(profile: str) -> Pins:
    """Return the packages of a file: version, condition and number of hashes, by name."""
    pins: Pins = defaultdict(list)
    text = (TREE / "etc" / "locked" / f"{profile}.txt").read_text()
    for entry in re.findall(r"^[^\s#].*?(?=^\S|\Z)", text, re.MULTILINE | re.DOTALL):
        line = Requirement(entry.partition("\\")[0])
        (only,) = line.specifier
        assert only.operator == "=="
        pins[canonicalize_name(line.name)].append((Version(only.version), line.marker, entry.count("--hash=sha256:")))
    return pins


def wanted(profile: str) -> list[Requirement]:
    """Return what pyproject.toml asks for."""
    project = tomllib.loads((TREE / "pyproject.toml").read_text())["project"]
    lines = [*project["dependencies"]]
    for extra in PROFILES[profile]:
        lines += project["optional-dependencies"][extra]
    return [Requirement(line) for line in lines]


def fits(need: Requirement, pins: Pins) -> bool:
    """Tell whether the line for this interpreter is such as is needed."""
    here = [version for version, marker, _ in pins[canonicalize_name(need.name)] if not marker or marker.evaluate()]
    return len(here) == 1 and need.specifier.contains(here[0], prereleases=True)


@pytest.mark.parametrize("profile", PROFILES)
def test_all_that_is_asked_for_is_locked_with_hashes(profile: str) -> None:
    pins = pinned(profile)
    assert [str(need) for need in wanted(profile) if not fits(need, pins)] == [], AGAIN
    assert [name for name, lines in pins.items() if not all(hashes for _, _, hashes in lines)] == []
    assert "://" not in (TREE / "etc" / "locked" / f"{profile}.txt").read_text()


@pytest.mark.parametrize("profile", PROFILES)
def test_what_is_needed_in_turn_is_locked_and_is_what_runs_here(profile: str) -> None:
    pins = pinned(profile)
    seen: set[tuple[str, str]] = set()
    queue = [(need, extra) for need in wanted(profile) for extra in ("", *need.extras)]
    while queue:
        need, extra = queue.pop()
        name = canonicalize_name(need.name)
        if (name, extra) in seen:
            continue
        seen.add((name, extra))
        assert fits(need, pins), f"{need}: {AGAIN}"
        versions = [version for version, marker, _ in pins[name] if not marker or marker.evaluate()]
        assert Version(importlib.metadata.version(name)) == versions[0], f"{name}: run ./dev setup"
        for line in importlib.metadata.requires(name) or []:
            more = Requirement(line)
            if more.marker is None or more.marker.evaluate({"extra": extra}):
                queue += [(more, one) for one in ("", *more.extras)]


def test_the_smaller_ones_take_the_versions_of_the_tests() -> None:
    tested = pinned("test")
    for profile in ("service", "run"):
        for name, lines in pinned(profile).items():
            assert {version for version, _, _ in lines} <= {version for version, _, _ in tested[name]}, name
