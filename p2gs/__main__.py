"""``python -m p2gs``: the same as ``p2gs``, and never in conflict with another package's script."""

import sys

from p2gs.cli import main

if __name__ == "__main__":
    sys.exit(main())
