"""``python -m sioms.reconcile``: the command by itself."""

import sys

from .command import main

if __name__ == "__main__":
    sys.exit(main())
