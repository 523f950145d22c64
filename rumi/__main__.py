"""`python -m rumi` is the command `rumi`."""

import sys

from rumi.cli import main

if __name__ == "__main__":
    sys.exit(main())
