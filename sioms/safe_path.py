"""No code from the working directory: whoever can write there must not decide what a program of ours runs.

``python -m`` puts the working directory first on the path, and so does an empty or relative entry of ``PYTHONPATH``.
All that is started by a program of ours is started with ``-P``; this is for what others start.
"""

import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Mapping


def leave_working_directory() -> None:
    """Take off the path what leads to the working directory; entries of ``PYTHONPATH`` that are absolute stay."""
    if sys.argv[:1] == ["-m"] and not sys.flags.safe_path:  # as the interpreter looks for the module
        del sys.path[0]
    strange = {"", *map(os.path.abspath, _relative(os.environ.get("PYTHONPATH", "")))}
    if len(strange) > 1 and not sys.flags.ignore_environment:
        sys.path[:] = [entry for entry in sys.path if entry not in strange]


def safe_environment(environment: "Mapping[str, str]") -> dict[str, str]:
    """Return an environment for a program of ours, with the absolute entries of ``PYTHONPATH`` alone."""
    safe = dict(environment)
    if _relative(safe.get("PYTHONPATH", "")):
        safe["PYTHONPATH"] = ":".join(filter(os.path.isabs, safe["PYTHONPATH"].split(":")))
    return safe


def _relative(path: str) -> list[str]:
    return [entry for entry in path.split(":") if not os.path.isabs(entry)] if path else []
