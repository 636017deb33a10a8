"""Sessions as other programs want them: LeRobot, MCAP, HDF5, and the folders of GenForce.

Every format's library is imported only when it is asked for. `docs/exporting.md` says what each
keeps and what it loses.
"""

from recorder.export.options import Options
from recorder.export.run import FORMATS, export

__all__ = ["FORMATS", "Options", "export"]
