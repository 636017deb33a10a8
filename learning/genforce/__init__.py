"""The published GenForce folders: read into marker archives, and written from them.

Three layouts: `training` (packed masks a contact point), `states` (simulated pictures) and `raw` (a
run as it was collected). No file has times: docs/markers.md says how frames are numbered.
"""

from learning.genforce.coefficients import (
    Compensation,
    read_coefficients,
    read_compensation,
    write_coefficients,
)
from learning.genforce.exporting import export_training
from learning.genforce.importing import LAYOUTS, import_folder, layout_of
from learning.genforce.masks import read_mask, write_mask

__all__ = [
    "LAYOUTS",
    "Compensation",
    "export_training",
    "import_folder",
    "layout_of",
    "read_coefficients",
    "read_compensation",
    "read_mask",
    "write_coefficients",
    "write_mask",
]
