"""Run ``python -m benchmarks.stress [FILTER]``, see :mod:`.suite`."""

import sys

from .suite import main

if __name__ == "__main__":
    sys.exit(main())
