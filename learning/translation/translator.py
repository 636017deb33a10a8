"""Interface of all translators, and their inputs."""

from dataclasses import dataclass
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
import torch

from learning.errors import LearningError
from recorder.archive import ArchivedSensor
from recorder.markers import HEIGHT, TAXELS, WIDTH, draw_discs, marker_centres, unpack

# Name of the translator that needs no training and therefore has no folder.
FLOW = "flow"

_SAME_DISCS_PX = 3.0  # an unloaded uSkin's disc lies within this distance of its drawn position


@dataclass(frozen=True, slots=True)
class SensorView:
    """Scale of a sensor's image on its surface."""

    name: str
    mm_per_column: float
    """Distance between the centres of neighbouring pixels in a row [mm]."""
    mm_per_row: float
    """Distance between the centres of neighbouring pixels in a column [mm]."""

    @classmethod
    def of(cls, sensor: ArchivedSensor) -> Self:
        """Return the view of an archived sensor.

        A uSkin's square surface is stretched to 640 x 480: `mm_per_row` is 4/3 of `mm_per_column`.

        Raises:
            SessionError: The references cannot be read.
        """
        stretched = WIDTH / HEIGHT if shows_discs(unpack(sensor.references[0])) else 1.0
        return cls(sensor.name, sensor.mm_per_px, stretched * sensor.mm_per_px)

    def pixels_of(self, other: Self) -> tuple[float, float]:
        """Return the size of another view's pixels in its own, along columns and rows."""
        return other.mm_per_column / self.mm_per_column, other.mm_per_row / self.mm_per_row


def shows_discs(reference: np.ndarray[Any, np.dtype[np.bool_]]) -> bool:
    """Return True if a reference mask (480, 640) shows a uSkin: discs at their drawn positions."""
    centres = marker_centres(reference)
    if len(centres) != TAXELS:
        return False
    drawn = marker_centres(draw_discs(np.zeros((TAXELS, 3))))
    apart = np.linalg.norm(drawn[:, None] - centres[None], axis=-1)
    return bool((apart.min(axis=1) <= _SAME_DISCS_PX).all())


@runtime_checkable
class Translator(Protocol):
    """Converts one sensor's frames to those another sensor would have shown."""

    @property
    def name(self) -> str:
        """Name in reports: its kind, and a suffix that identifies it within that kind."""

    def translate(
        self,
        source: torch.Tensor,
        target_reference: torch.Tensor,
        source_reference: torch.Tensor | None = None,
        *,
        ordered: bool = False,
    ) -> torch.Tensor:
        """Return the frames as the target would have shown them, bool (n, 480, 640).

        Source frames (n, 480, 640) are on any device, the result is there too; references are (480,
        640). If the source's is needed and missing, the first frame of a press in time order
        (`ordered`), which must begin without contact, is used.

        Raises:
            LearningError: Wrong shapes or types, or a required reference is missing.
        """


@runtime_checkable
class PairTranslator(Protocol):
    """A translator that depends on its two sensors, for instance on their scales.

    If `between_sensors` is not called, it assumes equal scales.
    """

    def between_sensors(self, source: SensorView, target: SensorView) -> Translator:
        """Return the translator for this pair."""


def for_pair(translator: Translator, source: SensorView, target: SensorView) -> Translator:
    """Return a translator for a pair of sensors; unchanged if it does not depend on them."""
    if isinstance(translator, PairTranslator):
        return translator.between_sensors(source, target)
    return translator


def require_masks(
    source: torch.Tensor, target_reference: torch.Tensor, source_reference: torch.Tensor | None
) -> None:
    """Reject inputs that are not masks.

    Raises:
        LearningError: Not bool, or not the shape of a mask.
    """
    inputs = {"source": source, "target_reference": target_reference}
    if source_reference is not None:
        inputs["source_reference"] = source_reference
    for what, masks in inputs.items():
        due = (len(source), HEIGHT, WIDTH) if what == "source" else (HEIGHT, WIDTH)
        if masks.dtype != torch.bool or tuple(masks.shape) != due:
            shape = ("n", *due[1:]) if what == "source" else due
            raise LearningError(
                f"{what}: found {str(masks.dtype).removeprefix('torch.')} {tuple(masks.shape)}; "
                f"allowed: bool {shape}"
            )


def source_reference_of(
    source: torch.Tensor, source_reference: torch.Tensor | None, *, ordered: bool
) -> torch.Tensor:
    """Return the source's reference, bool (480, 640): given, or an ordered press's first frame."""
    if source_reference is not None:
        return source_reference
    if not ordered:
        raise LearningError(
            "source_reference: missing; allowed: the source's reference, or an ordered press"
        )
    return source[0]
