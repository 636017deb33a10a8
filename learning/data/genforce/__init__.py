"""The published GenForce folders: read into marker archives, and written from them.

Three layouts: `training` (packed masks a contact point), `states` (simulated pictures) and `raw` (a
run as it was collected). No file has times: docs/markers.md says how frames are numbered.
"""

from learning.data.genforce.exporting import export_training
from learning.data.genforce.format import (
    Compensation,
    read_coefficients,
    read_compensation,
    read_mask,
    write_coefficients,
    write_mask,
)
from learning.data.genforce.importing import LAYOUTS, import_folder, layout_of

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
