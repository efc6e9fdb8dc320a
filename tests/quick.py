"""Choose the tests of `./dev test --quick`: those nearest to what has changed, within some minutes of measured time.

    python tests/quick.py [--since REVISION] [--seconds S]     print what would run, and why

What is left of the time goes to the quickest of the others. What has changed: against REVISION; without, what is not
    committed and what is not in the upstream branch, or the last
commit when there is neither. How near a test file is: by imports, from what it imports or names down to what has
    changed.
How long it takes: tests/durations.json, which `./dev test --durations` writes anew.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import subprocess
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

TREE = Path(__file__).resolve().parents[1]
DURATIONS = TREE / "tests" / "durations.json"
SECONDS = 240.0
"""Of tests, as they take one by one; two run at a time."""
UNKNOWN_S = 2.0
FAR = 99
"""Distance of a test that nothing leads to from what has changed."""
OUTER = ("daemon", "drivers", "tools")


@dataclass(frozen=True)
class Choice:
    """A test file: its path in the tree, how far it is from what has changed, and how long it takes [s]."""

    path: str
    distance: int
    seconds: float


def choose(distances: Mapping[str, int], seconds: Mapping[str, float], budget_s: float) -> list[Choice]:
    """Return the files that fit into a time, the nearest first, among equally near ones the quickest.

    Args:
        distances: of all test files.
        seconds: as measured; what is not in it takes UNKNOWN_S.
        budget_s: for all together; what has itself changed is taken even when it takes longer.
    """
    ranked = sorted(
        (Choice(path, far, seconds.get(path, UNKNOWN_S)) for path, far in distances.items()),
        key=lambda choice: (choice.distance, choice.seconds, choice.path),
    )
    chosen, left = [], budget_s
    for choice in ranked:
        if choice.seconds <= left or choice.distance == 0:
            chosen.append(choice)
            left -= choice.seconds
    return chosen


def distances(changed: Iterable[str], imports: Mapping[str, set[str]], tests: Mapping[str, set[str]]) -> dict[str, int]:
    """Return how many imports lead from each test file to what has changed, FAR for none.

    Args:
        changed: names of modules, and paths of test files.
        imports: what each module imports.
        tests: what each test file imports or names: modules, and other test files by path.
    """
    importers: dict[str, set[str]] = {}
    for name, imported in {**imports, **tests}.items():
        for each in imported:
            importers.setdefault(each, set()).add(name)
    found = dict.fromkeys(changed, 0)
    waiting = deque(found)
    while waiting:
        below = waiting.popleft()
        for name in importers.get(below, ()):
            if name not in found:
                found[name] = found[below] + 1
                waiting.append(name)
    return {path: found.get(path, FAR) for path in tests}


# --- the tree ------------------------------------------------------------------------------------


def changed_files(since: str) -> list[str]:
    """Return the paths in the tree of what has changed."""
    if since:
        return _git("diff", "--name-only", since) + _git("ls-files", "--others", "--exclude-standard")
    found = _git("diff", "--name-only", "HEAD") + _git("ls-files", "--others", "--exclude-standard")
    found += _git("diff", "--name-only", "@{upstream}...HEAD")
    return found or _git("diff", "--name-only", "HEAD~1")


def _git(*arguments: str) -> list[str]:
    done = subprocess.run(["git", *arguments], cwd=TREE, capture_output=True, text=True, check=False)
    return done.stdout.splitlines() if done.returncode == 0 else []


def module_of(path: str) -> str:
    """Return the name of the module that a file of the tree is, or whose package it lies in; '' for none."""
    parts = list(Path(path).with_suffix("").parts)
    if parts[0] in OUTER:
        parts = ["sioms", *parts]
    if parts[0] != "sioms":
        return ""
    return ".".join(parts[:-1] if parts[-1] == "__init__" or not path.endswith(".py") else parts)


def modules() -> dict[str, set[str]]:
    """Return what each module of the product imports of it."""
    import grimp

    graph = grimp.build_graph("sioms")
    return {name: set(graph.find_modules_directly_imported_by(name)) for name in graph.modules}


def test_files(known: Iterable[str]) -> dict[str, set[str]]:
    """Return what each file under tests imports or names of the modules known and of the other test files."""
    known = set(known)
    paths = {str(path.relative_to(TREE)): path for path in (TREE / "tests").rglob("*.py")}
    helpers = {Path(path).stem: path for path in paths if "/test_" not in path}
    folders = {str(Path(path).parent): path for path in paths if path.endswith("conftest.py")}
    found: dict[str, set[str]] = {}
    for name, path in paths.items():
        text = path.read_text(encoding="utf-8")
        named = set(re.findall(r"\bsioms(?:\.\w+)+", text))
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and node.module:
                named.add(node.module)
                named |= {f"{node.module}.{alias.name}" for alias in node.names}
            elif isinstance(node, ast.Import):
                named |= {alias.name for alias in node.names}
        uses = {module for module in named if module in known}
        uses |= {helpers[each] for each in named if each in helpers}
        uses |= {folders[str(above)] for above in Path(name).parents if str(above) in folders}
        found[name] = uses - {name}
    return found


def quick(since: str, budget_s: float) -> list[Choice]:
    """Return the test files to run."""
    known = modules()
    tests = test_files(known)
    changed = [path if path in tests else module_of(path) for path in changed_files(since)]
    far = distances([name for name in changed if name], known, tests)
    measured: dict[str, float] = json.loads(DURATIONS.read_text()) if DURATIONS.exists() else {}
    return choose({path: n for path, n in far.items() if "/test_" in path}, measured, budget_s)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--since", default="", metavar="REVISION", help="compare with this commit")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="time for all tests, one by one")
    args = parser.parse_args()
    chosen = quick(args.since, args.seconds)
    for choice in chosen:
        near = "far" if choice.distance == FAR else f"{choice.distance} imports away"
        print(f"{choice.seconds:6.1f} s  {near:16}  {choice.path}")
    print(f"{sum(choice.seconds for choice in chosen):6.1f} s  {len(chosen)} files")


if __name__ == "__main__":
    main()
