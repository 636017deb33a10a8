"""A package outside the repository that offers a translator by an entry point."""

from __future__ import annotations

from pathlib import Path

FOREIGN = """
import torch

from learning.translation import require_masks


class Still:
    name = "still"

    def __init__(self, folder):
        self.folder = folder

    def translate(self, source, target_reference, source_reference=None, *, ordered=False):
        require_masks(source, target_reference, source_reference)
        return target_reference.expand_as(source).clone()


def load(folder, device):
    return Still(folder)


def load_nothing(folder, device):
    return 3
"""
ENTRY_POINTS = """[tactile.models]
still = foreign_still:load
nothing = foreign_still:load_nothing
missing = foreign_still:absent
"""


def write_foreign_package(site: Path) -> None:
    """Write the package and its metadata into a folder, as pip would into site-packages."""
    (site / "foreign_still.py").write_text(FOREIGN)
    metadata = site / "foreign_still-2.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: foreign-still\nVersion: 2.1\n")
    (metadata / "entry_points.txt").write_text(ENTRY_POINTS)
