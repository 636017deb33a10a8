"""Import and export of the published GenForce folders.

There are three layouts: `training` (packed masks by contact point), `states` (simulated pictures)
and `raw` (a collection run). No file has times: docs/how-to/make-marker-archives.md describes the
numbering of frames.
"""

from learning.data.genforce.exporting import export_training
from learning.data.genforce.format import (
    Compensation,
    read_coefficients,
    read_compensation,
    read_mask,
    write_mask,
    write_numbers,
)
from learning.data.genforce.importing import LAYOUTS, import_folder, layout_of, read_plan

__all__ = [
    "LAYOUTS",
    "Compensation",
    "export_training",
    "import_folder",
    "layout_of",
    "read_coefficients",
    "read_compensation",
    "read_mask",
    "read_plan",
    "write_mask",
    "write_numbers",
]
