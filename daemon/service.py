"""The daemon as a process: its listening socket, its signals, its priority; and the check of a configuration."""

from __future__ import annotations

import errno
import os
import signal
import socket
import sys
from collections.abc import Sequence
from contextlib import suppress

from sioms.descriptors import permit_files
from sioms.protocol.socketpath import socket_path

from .config import Config, parse
from .fork_server import ForkServer
from .fork_server_process import ForkServerProcess
from .listening import Listening
from .loading import Loader, NotDescribed, Plan, read_config
from .log import Log
from .loop import Loop
from .needs import this_machine, told
from .realtime import end_promptly, run_ahead
from .server import Server
from .stop_record import StopRecord


def serve(config_path: str, given_path: str | None, level: str, process: ForkServerProcess) -> int:
    """Run the daemon; return the exit status.

    Args:
        config_path: of the configuration.
        given_path: where to listen; None: the configured or default path.
        level: least level that is logged.
        process: the fork server for the first configuration, just started.
    """
    log = Log(journal="JOURNAL_STREAM" in os.environ and "NOTIFY_SOCKET" in os.environ, level=level)
    loop = Loop()
    try:
        listening, record_path = _listen(config_path, given_path)
    except OSError as error:
        print(f"siomsd: listen: {error.strerror or error}", file=sys.stderr)
        return 1
    try:
        record = StopRecord(record_path)
    except OSError as error:
        listening.close()
        want = "free 1 MB there" if error.errno == errno.ENOSPC else "want a folder that the daemon may write to"
        print(
            f"siomsd: keep stops in {record_path}: {error.strerror}; {want} (state_folder in [workcell])",
            file=sys.stderr,
        )
        return 1
    _become_prompt(loop, log)
    permit_files()
    try:
        server = Server(loop, listening, config_path, log, record, process)
    except OSError as error:
        listening.close()
        what = error.filename or f"the stop-request files beside {listening.path}"
        print(f"siomsd: make {what}: {error.strerror}", file=sys.stderr)
        return 1
    _take_signals(loop, server)

    def loaded(errors: list[str]) -> None:
        if errors:
            server.exit_status = _status(errors)
            server.shutdown()

    server.load(loaded)
    try:
        loop.run()
    finally:
        server.stops.look()  # who has asked since the last look
        server.cell.shared.files.remove()
        record.close()
        listening.close()
    return server.exit_status


def _become_prompt(loop: Loop, log: Log) -> None:
    """Run ahead of all other processes, where allowed; what we start does not inherit it.

    For work, lest drivers keep it from us; and for the end: a killed process closes its sockets only when it gets a
    processor, and by that the drivers see that we are gone. Also an emergency stop or a SIGTERM through us then waits
    for nobody.
    """
    ahead = run_ahead()
    if not ahead:
        log("debug", "runs without SCHED_FIFO", why="it may not")
        return
    loop.be_prompt(ahead)
    for thread in os.listdir("/proc/self/task"):  # those that have begun; later ones do so by themselves
        if int(thread) != os.getpid():
            end_promptly(int(thread))


def check(path: str, process: ForkServerProcess) -> int:
    """Check a configuration and say what is wrong with it; return the exit status."""
    loop = Loop()
    result: list[str] = []

    def loaded(plan: Plan | None, errors: list[str]) -> None:
        result.extend(errors)
        loop.running = False
        if plan is not None:
            plan.fork_server.close()
            kinds = len(plan.names.nodes)
            print(f"{path}: ok; {len(plan.config.devices)} devices, {kinds} nodes")
            needed, shortages = told(plan.names, plan.config, this_machine())
            print(f"{path}: {needed}")
            for shortage in shortages:
                print(f"{path}: warning: {shortage}", file=sys.stderr)

    def died(fork_server: ForkServer) -> None:
        """Nothing to do: the loader's requests have been answered with the death."""

    def slow(progress: str) -> None:
        print(f"{path}: still being checked: {progress}", file=sys.stderr)

    Loader(loop, path, loaded, died, process, slow).start()
    if loop.running and not result:
        loop.run()
    for error in result:
        print(f"{path}: {error}", file=sys.stderr)
    return _status(result)


def _status(errors: Sequence[str]) -> int:
    """Return the exit status: 2, which a service manager does not try again, for a configuration that is wrong."""
    if all(isinstance(error, NotDescribed) for error in errors):
        return 1 if errors else 0
    return 2


def _listen(config_path: str, given: str | None) -> tuple[Listening, str]:
    """Return the listening socket, and the path of the record of stops."""
    config: Config | None = None
    with suppress(OSError, UnicodeDecodeError):  # the loader will report it, with all other errors
        config, _ = parse(read_config(config_path), os.path.dirname(config_path))
    table = config.workcell if config else None
    path = given or (table.socket if table else "") or socket_path()
    listening = Listening(path, int(table.socket_mode, 8) if table else 0o660, table.socket_group if table else "")
    folder = config.state_folder(os.environ) if config else ""
    return listening, os.path.join(folder, "stops") if folder else path + ".stops"


def _take_signals(loop: Loop, server: Server) -> None:
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    theirs.setblocking(False)
    signal.set_wakeup_fd(theirs.fileno())
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGCHLD):
        signal.signal(number, lambda *_: None)
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)

    def reloaded(errors: list[str]) -> None:
        server.cell.log("info", "reload", errors=len(errors))

    def take() -> None:
        for number in ours.recv(64):
            if number == signal.SIGHUP:
                server.load(reloaded)
            elif number in (signal.SIGTERM, signal.SIGINT):
                server.shutdown()
            elif number == signal.SIGCHLD:
                _reap()

    take.sockets = (ours, theirs)  # type: ignore[attr-defined]  # keep them open
    loop.watch(ours.fileno(), take)


def _reap() -> None:
    """Let go of all children that have ended: nurseries, and as the first process of a container also drivers."""
    with suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
