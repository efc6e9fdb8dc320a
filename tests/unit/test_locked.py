"""The locked packages: all that pyproject.toml asks for, with hashes, the same everywhere, and what is installed
here.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import re
import runpy
import subprocess
import tomllib
import zipfile
from collections import defaultdict
from pathlib import Path

import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

TREE = Path(__file__).resolve().parents[2]
DEV = runpy.run_path(str(TREE / "dev"))
PROFILES = DEV["EXTRAS"]
AGAIN = "run ./dev lock"
Pins = dict[str, list[tuple[Version, Marker | None, int]]]


def pinned(profile: str) -> Pins:
    """Return the packages of a file: version, condition and number of hashes, by name."""
    pins: Pins = defaultdict(list)
    for entry in re.findall(r"^[^\s#].*?(?=^\S|\Z)", DEV["listed"](profile), re.MULTILINE | re.DOTALL):
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


def test_the_larger_ones_begin_with_the_smaller_ones_and_no_package_stands_twice() -> None:
    lines = DEV["listed"]("test").splitlines()
    entries = [line for line in lines if line[:1] not in ("", " ", "#")]
    assert len(entries) == len(set(entries)) > 100
    assert all(set(DEV["pins"](smaller)) < set(DEV["pins"]("test")) for smaller in ("service", "run"))
    text = {profile: (TREE / "etc" / "locked" / f"{profile}.txt").read_text() for profile in PROFILES}
    assert [re.findall("^-r .*", text[name], re.MULTILINE) for name in PROFILES] == [
        ["-r run.txt"],
        ["-r service.txt"],
        [],
    ]


def wheel(folder: Path, name: str, version: str, *more: str) -> str:
    """Write a package without any module; return its hash."""
    info = f"{name}-{version}.dist-info"
    path = folder / f"{name}-{version}-py3-none-any.whl"
    about = ["Metadata-Version: 2.1", f"Name: {name}", f"Version: {version}", *more]
    form = ["Wheel-Version: 1.0", "Generator: test", "Root-Is-Purelib: true", "Tag: py3-none-any"]
    with zipfile.ZipFile(path, "w") as file:
        file.writestr(f"{info}/METADATA", "\n".join(about) + "\n")
        file.writestr(f"{info}/WHEEL", "\n".join(form) + "\n")
        file.writestr(f"{info}/RECORD", "")
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_newer_release_of_what_is_needed_with_an_extra_changes_nothing(tmp_path: Path) -> None:
    """The installation was refused the day that `coverage` had a release after the one locked."""
    above = wheel(tmp_path, "above", "1.0", "Requires-Dist: below[more]>=1.0")
    below = wheel(tmp_path, "below", "1.0", "Provides-Extra: more")
    wheel(tmp_path, "below", "1.1", "Provides-Extra: more")
    locked = tmp_path / "locked.txt"
    locked.write_text(f"above==1.0 --hash=sha256:{above}\nbelow==1.0 --hash=sha256:{below}\n")
    pip = DEV["find_pip"]()
    place = tmp_path / "place"
    command = [*pip, "install", "--isolated", "--no-index", f"--find-links={tmp_path}", f"--target={place}"]
    done = subprocess.run([*command, *DEV["just"](locked)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in place.glob("*.dist-info")) == ["above-1.0.dist-info", "below-1.0.dist-info"]


def test_every_installation_of_a_list_that_is_documented_takes_it_alone() -> None:
    pages = [TREE / "README.md", *(TREE / "docs").glob("*.md")]
    commands = [
        line
        for page in pages
        for line in page.read_text().replace("\\\n", " ").splitlines()
        if "install" in line and "-r etc/locked" in line
    ]
    assert commands
    assert [line for line in commands if "--no-deps" not in line or "--require-hashes" not in line] == []
