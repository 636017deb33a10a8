"""Command line of the simulator: `python -m sim COMMAND`."""

import sys
from functools import partial

from recorder.command_line import run

main = partial(run.main, package="sim")

if __name__ == "__main__":
    sys.exit(main())
