"""Makes the library of the compiled steps, and the compiled ``devin`` and ``devout`` beside it:
``python -m sioms.native.build [-o FOLDER] [COMPILER...]``.

A compiler is any command that takes the options of cc: ``cc``, or ``python -m ziglang cc`` of the package ziglang,
which brings all it needs. No header and no library of Python is wanted, so one library serves all versions of it.
"""

from __future__ import annotations

import argparse
import importlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from . import language
from .translate import translate

OPTIONS = (
    "-std=gnu11", "-O2", "-ffp-contract=off", "-fno-fast-math", "-fvisibility=default",
    "-Werror=implicit-function-declaration",
)  # fmt: skip
"""A function without a declaration is refused by some compilers and taken for another by others."""
TOOLS, TOOLS_SOURCE = ("devin", "devout"), "sioms.tools.compiled"


def build(folder: Path, compiler: list[str]) -> None:
    """Make all.

    Args:
        folder: where to; each appears whole or not at all.
        compiler: command that takes the options of cc.

    Raises:
        OSError, subprocess.CalledProcessError: the compiler is not there, or refuses.
    """
    source = importlib.import_module(TOOLS_SOURCE).source  # it stands above: it knows the options of the tools
    made: list[tuple[Path, str, tuple[str, ...]]] = [
        (folder / language.LIBRARY.name, translate(language.MODULES), ("-fPIC", "-shared")),
        *((folder / f"_{tool}", source(tool), ()) for tool in TOOLS),
    ]
    for target, text, shared in made:
        with tempfile.TemporaryDirectory() as place:
            code, program = Path(place) / "source.c", Path(place) / "made"
            code.write_text(text)
            subprocess.run([*compiler, *OPTIONS, *shared, str(code), "-o", str(program), "-lm"], check=True)
            fresh = target.with_name(f"{target.name}.{os.getpid()}")
            fresh.write_bytes(program.read_bytes())
            fresh.chmod(0o755)
            fresh.replace(target)


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m sioms.native.build", description="compile the steps, devin and devout"
    )
    parser.add_argument("-o", "--output", type=Path, default=language.LIBRARY.parent, metavar="FOLDER")
    parser.add_argument("--show", action="store_true", help="print the C of the steps instead")
    parser.add_argument("compiler", nargs="*", default=["cc"])
    options = parser.parse_args()
    if options.show:
        print(translate(language.MODULES))
        return 0
    build(options.output, options.compiler)
    return 0


if __name__ == "__main__":
    sys.exit(main())
