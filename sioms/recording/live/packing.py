"""Packs one recording aside: ``python -m sioms.recording.live.packing FILE``."""

import sys

from sioms.recording.rewrite import rewrite

if __name__ == "__main__":
    rewrite([sys.argv[1]], sys.argv[1])
