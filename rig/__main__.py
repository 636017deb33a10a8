"""Command line of the rig: `python -m rig COMMAND`."""

import sys
from functools import partial

from recorder.command_line import run

main = partial(run.main, package="rig")

if __name__ == "__main__":
    sys.exit(main())
