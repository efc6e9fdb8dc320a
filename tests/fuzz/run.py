"""Search for bytes that break a decoder, guided by coverage: ``python tests/fuzz/run.py TARGET [--seconds N]``.

With atheris (``pip install atheris``) libFuzzer finds the way by what the bytes reach; without it, random changes of the seeds
are tried. Bytes that break a target are left in ``crash-*`` in the working directory; they belong into ``corpus.py``.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))


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


def main() -> None:
    """Run one target, or all in turn with random changes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long")
    parser.add_argument("--runs", type=int, default=-1, help="executions at most")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    try:
        import atheris
    except ImportError:
        atheris = None
    if atheris is None:
        from fuzz.targets import TARGETS, feed

        target, chance, count = TARGETS[args.target], random.Random(args.seed), 0
        until = time.monotonic() + args.seconds
        while time.monotonic() < until and count != args.runs:
            feed(target, changed(chance, chance.choice(target.seeds)))
            count += 1
        print(f"{args.target}: {count} executions")
        return
    with atheris.instrument_imports(include=["sioms", "fuzz"]):
        from fuzz.targets import TARGETS, feed
    target = TARGETS[args.target]
    folder = Path(tempfile.mkdtemp())
    for i, seed in enumerate(target.seeds):
        (folder / str(i)).write_bytes(seed)
    limits = [
        f"-max_total_time={args.seconds:.0f}",
        f"-runs={args.runs}",
        f"-seed={args.seed}",
        "-max_len=8192",
    ]
    atheris.Setup(
        [sys.argv[0], *limits, "-rss_limit_mb=1500", "-timeout=20", "-print_final_stats=1", str(folder)],
        lambda data: feed(target, data) and None,
    )
    atheris.Fuzz()


if __name__ == "__main__":
    main()
