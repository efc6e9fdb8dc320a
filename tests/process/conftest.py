"""Fixtures of the tests that run the real daemon."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from daemon_rig import Client, Daemon, daemons
from shell_rig import Shell, run_line

import sioms


@pytest.fixture
def start_daemon() -> Iterator[Callable[..., Daemon]]:
    """Start daemons, ``start_daemon(text=WORKCELL, env=None)``; all end with the test."""
    with daemons() as start:
        yield start


@pytest.fixture(scope="module")
def shared_daemon() -> Iterator[Daemon]:
    """One daemon for the tests of a module, which leave it as they found it."""
    with daemons() as start:
        yield start()


@pytest.fixture
def daemon(shared_daemon: Daemon) -> Iterator[Daemon]:
    """The module's daemon with nothing stopped, nothing held and everything up."""
    with shared_daemon.cell("reset") as cell:
        cell.reset()
        for device in cell.status()["devices"]:
            shared_daemon.wait_up(device["name"])
    yield shared_daemon


@pytest.fixture
def cell(daemon: Daemon) -> Iterator[sioms.Workcell]:
    """A session with the module's daemon."""
    with daemon.cell("tester") as opened:
        yield opened


@pytest.fixture
def shell(daemon: Daemon, tmp_path: Path) -> Shell:
    """Run lines of bash with the tools on their path, in a fresh folder: ``shell(line, text="", socket=...)``."""

    def run(line: str, text: str = "", socket: str = daemon.socket) -> subprocess.CompletedProcess[str]:
        return run_line(line, text, socket, tmp_path)

    return run


@pytest.fixture
def client() -> Iterator[Callable[..., Client]]:
    """Start clients as processes, ``client(daemon, script)``; all end with the test."""
    running: list[Client] = []

    def start(*arguments: object) -> Client:
        running.append(Client(*arguments))  # type: ignore[arg-type]
        return running[-1]

    yield start
    for one in running:
        one.end()
