"""Import of the published GenForce folders.

There are three layouts: `training` (packed masks by contact point), `states` (simulated pictures)
and `raw` (a collection run). No file has times: docs/how-to/make-marker-archives.md describes the
numbering of frames.
"""

from learning.data.genforce.format import (
    Compensation,
    read_coefficients,
    read_compensation,
    read_mask,
)
from learning.data.genforce.importing import LAYOUTS, import_folder, layout_of, read_plan

__all__ = [
    "LAYOUTS",
    "Compensation",
    "import_folder",
    "layout_of",
    "read_coefficients",
    "read_compensation",
    "read_mask",
    "read_plan",
]
