"""The search for bytes that break one decoder, in a process of its own: ``python -m sioms.bench.search HOW TARGET RUNS
SEED FOLDER``.

``guided``: libFuzzer finds the way by what the bytes reach, and keeps what reached something new in the folder; it
needs atheris (``pip install atheris``). ``random``: changes at random of what is in the folder, many times as fast.
Bytes that break a target are left in ``fuzz-*`` in the working directory.
"""

from __future__ import annotations

import importlib.util
import mmap
import random
import sys
from collections.abc import Callable
from pathlib import Path

LONGEST = 8192
"""Bytes of an input at most."""
MEMORY_MB = 1500
SLOWEST_S = 20


def changed(chance: random.Random, data: bytes) -> bytes:
    """Return bytes with a few random changes."""
    out = bytearray(data)
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(len(out) + 1)
        match chance.randrange(5):
            case 0:
                out[at : at + 1] = bytes([chance.randrange(256)])
            case 1:
                out[at:at] = chance.randbytes(chance.randint(1, 8))
            case 2:
                del out[at : at + chance.randint(1, 8)]
            case 3:
                end = at + chance.randint(1, 16)
                out[at:at] = out[at:end] * chance.choice((1, 2, 40))
            case _:
                del out[at:]
    return bytes(out)


def guided() -> bool:
    """Tell whether coverage guides the search."""
    return importlib.util.find_spec("atheris") is not None


def counter(path: str) -> memoryview:
    """Return the number of inputs tried so far, in a file of 8 bytes that two processes map."""
    with open(path, "r+b") as file:
        return memoryview(mmap.mmap(file.fileno(), 8)).cast("Q")


def _at_random(name: str, runs: int, seed: int, folder: Path, tried: memoryview) -> None:
    from .decoders import TARGETS, feed

    target, chance = TARGETS[name], random.Random(seed)
    begin = [*target.seeds, *(path.read_bytes() for path in sorted((folder / "corpus").iterdir()))]
    for count in range(1, runs + 1):
        data = changed(chance, chance.choice(begin))
        try:
            feed(target, data)
        except BaseException:
            Path(f"fuzz-{name.replace(' ', '-')}-{seed}-{count}").write_bytes(data)
            raise
        tried[0] += 1


def _guided(name: str, runs: int, seed: int, folder: Path, tried: memoryview) -> None:
    import atheris

    with atheris.instrument_imports(include=["sioms", "tomllib"]):
        from .decoders import TARGETS, feed
    target, corpus = TARGETS[name], folder / "corpus"
    for i, data in enumerate(target.seeds):
        (corpus / str(i)).write_bytes(data)

    def one(data: bytes) -> None:
        feed(target, data)
        tried[0] += 1

    bounds = {
        "runs": runs, "seed": seed, "max_len": LONGEST, "rss_limit_mb": MEMORY_MB, "timeout": SLOWEST_S,
        "artifact_prefix": f"fuzz-{name.replace(' ', '-')}-",
    }  # fmt: skip
    atheris.Setup([sys.argv[0], *(f"-{key}={value}" for key, value in bounds.items()), str(corpus)], one)
    atheris.Fuzz()


def main() -> None:
    """Search for bytes that break one target."""
    how, name, runs, seed, folder = sys.argv[1:]
    search: Callable[[str, int, int, Path, memoryview], None] = _guided if how == "guided" else _at_random
    search(name, int(runs), int(seed), Path(folder), counter(f"{folder}/count"))


if __name__ == "__main__":
    main()
