"""Command line of the project: `tactile COMMAND`."""

import sys

from tactile.run import main

if __name__ == "__main__":
    sys.exit(main())
