"""A package outside the repository that offers a translator and a force model by entry points."""

import sys
from collections.abc import Iterator
from typing import Any

import pytest

FOREIGN = """
import torch

from learning.force.model import ForceModel, ForceNetworkSettings, InputSettings
from learning.training.checkpoint import read_model_folder
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


class MeanForce(ForceModel):
    # An encoder of its own: means of 8 x 8 pixels.
    def __init__(self):
        network = ForceNetworkSettings(encoder=(4, 4, 8), blocks=1, memory=8, tail=(8, 8))
        super().__init__(network, InputSettings(form="image", side_px=32))
        self.encoder = torch.nn.Sequential(
            torch.nn.AvgPool2d(8), torch.nn.Conv2d(1, 8, 1), torch.nn.ReLU()
        )


def load_force(folder, device):
    model = MeanForce()
    if folder is not None:
        read_model_folder(folder).load(model, device)
    return model
"""
ENTRY_POINTS = """[tactile.models]
still = foreign_still:load
nothing = foreign_still:load_nothing
mean-force = foreign_still:load_force
missing = foreign_still:absent
"""


def installed() -> Any:
    """Return a fixture: the package in a folder, as pip would put it into site-packages."""
    return pytest.fixture(scope="module", autouse=True)(_package)


def _package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    site = tmp_path_factory.mktemp("site")
    (site / "foreign_still.py").write_text(FOREIGN)
    metadata = site / "foreign_still-2.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: foreign-still\nVersion: 2.1\n")
    (metadata / "entry_points.txt").write_text(ENTRY_POINTS)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(site))
        patch.delitem(sys.modules, "foreign_still", raising=False)
        yield
