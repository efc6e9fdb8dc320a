"""Makes the library of the compiled steps: ``python -m sioms.native.build [-o FILE] [COMPILER...]``.

A compiler is any command that takes the options of cc: ``cc``, or ``python -m ziglang cc`` of the package ziglang,
which brings all it needs. No header and no library of Python is wanted, so one library serves all versions of it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from . import language
from .translate import translate

OPTIONS = ("-std=gnu11", "-O2", "-fPIC", "-shared", "-ffp-contract=off", "-fno-fast-math", "-fvisibility=default")


def build(target: Path, compiler: list[str]) -> None:
    """Make the library.

    Args:
        target: where to; it appears whole or not at all.
        compiler: command that takes the options of cc.

    Raises:
        OSError, subprocess.CalledProcessError: the compiler is not there, or refuses.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, made = Path(folder) / "steps.c", Path(folder) / "steps.so"
        source.write_text(translate(language.MODULES))
        subprocess.run([*compiler, *OPTIONS, str(source), "-o", str(made), "-lm"], check=True)
        fresh = target.with_name(f"{target.name}.{os.getpid()}")
        fresh.write_bytes(made.read_bytes())
        fresh.chmod(0o755)
        fresh.replace(target)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m sioms.native.build", description="compile the steps")
    parser.add_argument("-o", "--output", type=Path, default=language.LIBRARY, metavar="FILE")
    parser.add_argument("--show", action="store_true", help="print the C file instead")
    parser.add_argument("compiler", nargs="*", default=["cc"])
    options = parser.parse_args()
    if options.show:
        print(translate(language.MODULES))
        return 0
    build(options.output, options.compiler)
    return 0


if __name__ == "__main__":
    sys.exit(main())
