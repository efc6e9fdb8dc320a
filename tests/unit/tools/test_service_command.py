"""``sioms service``: everything in place, what somebody changed kept, everything of ours gone again."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from sioms.tools import service
from sioms.tools.front import main

installs = pytest.mark.skipif(" " in sys.prefix, reason="an environment in a path with a space is refused")


def files(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if path.is_symlink() or path.is_file()}


def install(root: Path, *words: str) -> int:
    return main(["service", "install", "--root", str(root), *words])


@installs
def test_everything_is_put_in_place_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert install(tmp_path, "--dry-run") == 0 and not files(tmp_path)
    assert install(tmp_path) == 0
    assert {
        "etc/systemd/system/sioms.service", "etc/sysusers.d/sioms.conf", "etc/tmpfiles.d/sioms.conf",
        "etc/udev/rules.d/60-sioms.rules", "etc/sioms/workcell.toml", "usr/local/share/man/man1/devin.1",
        "usr/local/share/man/man8/siomsd.8", "usr/local/bin/devin",
        "usr/local/share/bash-completion/completions/smarkers",
    } <= files(tmp_path)  # fmt: skip
    assert os.readlink(tmp_path / "usr/local/bin/siomsd") == f"{sys.prefix}/bin/siomsd"
    unit = (tmp_path / "etc/systemd/system/sioms.service").read_text()
    assert f"ExecStart={sys.prefix}/bin/siomsd --config /etc/sioms/workcell.toml" in unit
    capsys.readouterr()
    assert install(tmp_path) == 0
    assert {line.split()[0] for line in capsys.readouterr().out.splitlines()} == {"in"}


@installs
def test_what_somebody_changed_is_kept(tmp_path: Path) -> None:
    install(tmp_path)
    for name in (
        "etc/systemd/system/sioms.service",
        "etc/udev/rules.d/60-sioms.rules",
        "etc/sioms/workcell.toml",
    ):
        (tmp_path / name).write_text("mine")
    install(tmp_path)
    assert (tmp_path / "etc/systemd/system/sioms.service").read_text() == "mine"
    install(tmp_path, "--force")
    assert "ExecStart" in (tmp_path / "etc/systemd/system/sioms.service").read_text()
    for name in ("etc/udev/rules.d/60-sioms.rules", "etc/sioms/workcell.toml"):
        assert (tmp_path / name).read_text() == "mine"


@installs
def test_removing_leaves_the_configuration_and_what_is_not_ours(tmp_path: Path) -> None:
    install(tmp_path)
    (tmp_path / "usr/local/bin/devin").unlink()
    (tmp_path / "usr/local/bin/devin").write_text("another's")
    assert main(["service", "remove", "--root", str(tmp_path)]) == 0
    assert files(tmp_path) == {
        "etc/sioms/workcell.toml", "etc/udev/rules.d/60-sioms.rules", "usr/local/bin/devin",
    }  # fmt: skip


def test_an_environment_that_the_service_cannot_see_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "prefix", "/home/eva/venv")
    monkeypatch.setattr(service.Item, "put", lambda *_: pytest.fail("something was written"))
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert main(["service", "install"]) == 1
    assert "does not see /home; install SIOMS into /opt/sioms" in capsys.readouterr().err


def test_an_environment_in_a_path_with_a_space_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "my lab"))
    assert install(tmp_path) == 1 and not files(tmp_path)
    assert "my lab contains a space" in capsys.readouterr().err


def test_only_root_may(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert main(["service", "install"]) == 1
    assert "run it as root, or with --dry-run" in capsys.readouterr().err


@pytest.mark.parametrize("action", ["install", "remove"])
def test_a_mistyped_root_is_not_made(tmp_path: Path, capsys: pytest.CaptureFixture[str], action: str) -> None:
    assert main(["service", action, "--root", str(tmp_path / "imgae")]) == 1
    assert "imgae: no such folder; make it, or name another" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
