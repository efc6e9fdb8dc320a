"""Puts small faults into copies of the tree, one at a time, and sees that a test finds each.

./dev run python tests/mutants/run.py [-j N] [NAME...]     # names: parts of them; without, all
"""

from __future__ import annotations

import argparse
import queue
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

TREE = Path(__file__).resolve().parents[2]
STARTED = ("daemon/", "drivers/", "sioms/gateway/", "sioms/motion/", "sioms/sdk/")
"""What tests of processes start from the tree that is installed, which is not the copy with the fault."""
LONGEST_S = 600.0
"""A mutant whose tests take longer hangs: that is a find, too."""


class Mutant(NamedTuple):
    """A fault: in a file the old text, which is there once, becomes the new one; some of the tests shall fail."""

    name: str
    file: str
    old: str
    new: str
    tests: list[str]


def mutants() -> list[Mutant]:
    """Return all of them."""
    with open(Path(__file__).with_name("mutants.toml"), "rb") as file:
        data = tomllib.load(file)
    return [Mutant(**{**table, "tests": data["tests"][table["tests"]]}) for table in data["mutant"]]


def unseen(mutant: Mutant) -> str:
    """Return why none of its tests can find a fault; '': one may."""
    if not mutant.file.startswith(STARTED) or any(not test.startswith("tests/process/") for test in mutant.tests):
        return ""
    return (
        f"{mutant.name}: its tests are of processes, which are started from the installed tree, not from the copy "
        f"of {mutant.file}; want a test that imports it"
    )


def copy_tree(to: Path) -> None:
    """Copy what git knows of the tree, and what is new in it."""
    command = ["git", "-C", str(TREE), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(command, check=True, capture_output=True).stdout.decode().split("\0"):
        if name and (TREE / name).is_symlink() | (TREE / name).is_file():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(TREE / name, to / name, follow_symlinks=False)


def run_tests(tree: Path, tests: list[str]) -> int:
    """Run tests in a copy of the tree, up to the first that fails; return the exit status of pytest."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--timeout=120", *tests]
    try:
        return subprocess.run(command, cwd=tree, capture_output=True, timeout=LONGEST_S, check=False).returncode
    except subprocess.TimeoutExpired:
        return 1


def try_mutant(mutant: Mutant, trees: queue.Queue[Path]) -> bool:
    """Return whether a test finds a fault."""
    tree, began_s = trees.get(), time.perf_counter()
    path = tree / mutant.file
    text = path.read_text(encoding="utf-8")
    try:
        path.write_text(text.replace(mutant.old, mutant.new), encoding="utf-8")
        status = run_tests(tree, mutant.tests)
    finally:
        path.write_text(text, encoding="utf-8")
        trees.put(tree)
    found = status == 1  # of pytest: tests have failed; 2 and more: they could not be run
    print(f"{'killed' if found else 'LIVES'} {time.perf_counter() - began_s:6.1f} s  {mutant.name}", flush=True)
    return found


def main(arguments: list[str]) -> int:
    """Try all mutants, or those that are named; return how many live."""
    parser = argparse.ArgumentParser(description="See that the tests find small faults.")
    parser.add_argument("-j", type=int, default=1, help="how many at a time")
    parser.add_argument("names", nargs="*", help="parts of their names")
    options = parser.parse_args(arguments)
    chosen = [m for m in mutants() if not options.names or any(name in m.name for name in options.names)]
    if why := "\n".join(filter(None, map(unseen, chosen))):
        print(why)
        return 1
    trees: queue.Queue[Path] = queue.Queue()
    with (
        tempfile.TemporaryDirectory(prefix="sioms-mutants-") as folder,
        ThreadPoolExecutor(options.j) as pool,
    ):
        for number in range(options.j):
            copy_tree(Path(folder) / str(number))
            trees.put(Path(folder) / str(number))
        tests = sorted({test for mutant in chosen for test in mutant.tests})
        if run_tests(Path(folder) / "0", tests):
            print("the tests fail without any fault: mend that first")
            return 1
        found = list(pool.map(lambda mutant: try_mutant(mutant, trees), chosen))
    print(f"{sum(found)} of {len(found)} killed")
    return len(found) - sum(found)


if __name__ == "__main__":
    sys.exit(min(main(sys.argv[1:]), 99))
