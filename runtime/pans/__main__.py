"""`python -m pans` is `pans`."""

import sys

from pans.app.main import main

if __name__ == "__main__":
    sys.exit(main())
