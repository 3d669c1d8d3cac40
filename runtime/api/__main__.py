"""`python -m pans` is `pans`."""

import sys

from pans.runtime.cli import main

if __name__ == "__main__":
    sys.exit(main())
