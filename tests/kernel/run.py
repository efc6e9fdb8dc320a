#!/usr/bin/env python3
"""Run the tests of this folder on a Linux kernel that has simulated GPIO lines and a dummy IIO device.

    .venv/bin/python tests/kernel/run.py [--source DIR-OR-TAR] [--build DIR] [--timeout S] [PYTEST-ARGUMENT ...]

The kernel is a User Mode Linux: a process without any rights, without a virtual machine, that sees the files of this
computer read-only. It is built once, from the sources of a distribution (5 minutes on two processors), and kept; a run
takes three minutes.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
TREE = HERE.parents[1]
CONFIG = HERE / "linux.config"
NEEDED = ("make", "gcc", "flex", "bison", "bc")
MEMORY_MB = 1024
ENDED = re.compile(r"run\.py: ended with (\d+)")


class Missing(Exception):
    """What is not there, and how to get it: one sentence."""


def find_source() -> Path:
    """Return the newest kernel source that the distribution has installed.

    Raises:
        Missing: there is none.
    """
    found = sorted(Path("/usr/src").glob("linux-source-*.tar.*"), key=lambda path: path.stat().st_mtime)
    if not found:
        raise Missing("no kernel source in /usr/src; apt-get install linux-source, or name one by --source")
    return found[-1]


def build(source: Path, folder: Path) -> Path:
    """Return a kernel built of a source tree or archive with our configuration; at once when it is there.

    Raises:
        Missing: a tool is not there, or the build failed.
    """
    stamp = hashlib.sha256(f"{source.resolve()}\n{CONFIG.read_text()}".encode()).hexdigest()[:12]
    kernel = folder / f"linux-{stamp}"
    if kernel.exists():
        return kernel
    if absent := [tool for tool in NEEDED if shutil.which(tool) is None]:
        raise Missing(f"{', '.join(absent)} not found; apt-get install {' '.join(absent)}")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as work:
        tree, objects, log = source, Path(work) / "build", folder / "build.log"
        print(f"run.py: building a kernel of {source}, some minutes; log {log}", flush=True)
        with log.open("wb") as out:
            if source.is_file():
                command(["tar", "xf", str(source), "-C", work], out)
                tree = next(path for path in Path(work).iterdir() if path.is_dir())
            objects.mkdir()
            make = ["make", "-C", str(tree), "ARCH=um", f"O={objects}"]
            command([*make, f"KCONFIG_ALLCONFIG={CONFIG}", "allnoconfig"], out)
            if lost := set(wanted(CONFIG)) - set(wanted(objects / ".config")):
                raise Missing(f"this source has no {', '.join(sorted(lost))}; want Linux 5.17 or later")
            command([*make, f"-j{os.cpu_count()}", "linux"], out)
        shutil.copy2(objects / "linux", kernel)
    return kernel


def wanted(config: Path) -> list[str]:
    """Return what a configuration switches on."""
    return [line for line in config.read_text().splitlines() if line.startswith("CONFIG_")]


def command(words: list[str], out: object) -> None:
    """Run a step of the build."""
    if subprocess.run(words, stdout=out, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL).returncode:  # type: ignore[call-overload]
        raise Missing(f"{' '.join(words)} failed; its last words are in the log")


def run(kernel: Path, arguments: list[str], timeout_s: float) -> int:
    """Boot the kernel, run pytest in it, and return pytest's status; print what it says.

    Args:
        kernel: the program.
        arguments: of pytest.
        timeout_s: after this the kernel and all in it are killed.
    """
    words = [str(kernel), f"mem={MEMORY_MB}M", "root=none", "rootfstype=hostfs", "rootflags=/", "ro", "quiet"]
    words += ["con=null", "con0=null,fd:1", "console=tty0", f"init={HERE / 'boot'}", "--"]
    words += [f'"{word}"' if " " in word else word for word in (str(TREE), sys.executable, *arguments)]
    with tempfile.TemporaryDirectory(prefix="sioms-uml-") as folder:
        process = subprocess.Popen(
            [*words[:1], f"uml_dir={folder}", *words[1:]], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, text=True, errors="replace", start_new_session=True,
            env={**os.environ, "TMPDIR": folder},
        )  # fmt: skip
        signal.signal(signal.SIGALRM, lambda *_: kill(process))
        signal.setitimer(signal.ITIMER_REAL, timeout_s)
        status = None
        try:
            for line in process.stdout or ():
                if found := ENDED.search(line):
                    status = int(found[1])
                    break
                print(line.rstrip(), flush=True)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            kill(process)
            process.wait()
    if status is None:
        print(f"run.py: the kernel ended, or {timeout_s:g} s went by, before the tests did", file=sys.stderr)
    return 1 if status is None else status


def kill(process: subprocess.Popen[str]) -> None:
    """End the kernel and its processes, which are all of one group."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def main() -> int:
    """Build if need be, boot, test."""
    parser = argparse.ArgumentParser(description="run tests/kernel on a User Mode Linux")
    parser.add_argument(
        "--source",
        type=Path,
        help="kernel source, a folder or an archive; the newest in /usr/src unless given",
    )
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    parser.add_argument(
        "--build", type=Path, default=cache / "sioms-kernel", help="where kernels are kept (%(default)s)"
    )
    parser.add_argument(
        "--timeout", type=float, default=900.0, help="longest that the tests may take [s] (%(default)g)"
    )
    options, arguments = parser.parse_known_args()
    try:
        kernel = build(options.source or find_source(), options.build)
    except Missing as missing:
        print(f"run.py: {missing}", file=sys.stderr)
        return 2
    if not any(Path(word.partition("::")[0]).exists() for word in arguments):
        arguments += ["-v", str(HERE)]
    return run(kernel, arguments, options.timeout)


if __name__ == "__main__":
    sys.exit(main())
