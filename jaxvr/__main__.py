"""`python -m jaxvr` is the command `jaxvr`."""

import sys

from jaxvr.cli import main

if __name__ == "__main__":
    sys.exit(main())
