"""What every translator does, and what it is given."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Self, runtime_checkable

import numpy as np

from learning.errors import LearningError
from recorder.markers import HEIGHT, TAXELS, WIDTH, draw_discs, marker_centres, unpack

if TYPE_CHECKING:
    import torch

    from recorder.archive import ArchivedSensor

# Name of the translator that needs no training, and so no folder.
FLOW = "flow"

_SAME_DISCS_PX = 3.0  # a disc of an untouched uSkin lies within this of where it is drawn


@dataclass(frozen=True, slots=True)
class SensorView:
    """What the image of a sensor shows of its surface."""

    name: str
    """Of the sensor."""
    mm_per_column: float
    """From the middle of a pixel to that of its neighbour in a row [mm]."""
    mm_per_row: float
    """From the middle of a pixel to that of the one below [mm]."""

    @classmethod
    def of(cls, sensor: ArchivedSensor) -> Self:
        """Return the view of an archived sensor.

        The image of a uSkin stretches a square to 640 x 480: along rows a pixel is 4/3 as large.

        Raises:
            SessionError: The references cannot be read.
        """
        stretched = WIDTH / HEIGHT if shows_discs(unpack(sensor.references[0])) else 1.0
        return cls(sensor.name, sensor.mm_per_px, stretched * sensor.mm_per_px)


def shows_discs(reference: np.ndarray[Any, np.dtype[np.bool_]]) -> bool:
    """Return whether an untouched mask (480, 640) is that of a uSkin: its discs in their places."""
    found = marker_centres(reference)
    if len(found) != TAXELS:
        return False
    drawn = marker_centres(draw_discs(np.zeros((TAXELS, 3))))
    apart = np.linalg.norm(drawn[:, None] - found[None], axis=-1)
    return bool((apart.min(axis=1) <= _SAME_DISCS_PX).all())


class Translator(Protocol):
    """Makes of a sensor's frames what another sensor would have shown."""

    @property
    def name(self) -> str:
        """How it is called in reports: its kind, and what tells it from others of that kind."""
        ...

    def translate(
        self,
        source: torch.Tensor,
        target_reference: torch.Tensor,
        source_reference: torch.Tensor | None = None,
        *,
        ordered: bool = False,
    ) -> torch.Tensor:
        """Return the frames as the target would have shown them, bool (n, 480, 640).

        Args:
            source: Masks of the source, bool (n, 480, 640), on any device; the result is on it too.
            target_reference: The untouched target, bool (480, 640).
            source_reference: The untouched source, bool (480, 640). Without it the first frame of
                an ordered press is taken where one is needed.
            ordered: The frames are one press in order of time. Without a source reference it begins
                untouched.

        Raises:
            LearningError: Wrong shapes or types, or a reference that is needed and not there.
        """
        ...


@runtime_checkable
class PairTranslator(Protocol):
    """A translator that has to know which two sensors it goes between, for instance their scales.

    Called without, it takes them to be of the same scale.
    """

    def between(self, source: SensorView, target: SensorView) -> Translator:
        """Return the translator of this pair."""
        ...


def aimed(translator: Translator, source: SensorView, target: SensorView) -> Translator:
    """Return a translator for a pair of sensors; itself, where it needs not know them."""
    if isinstance(translator, PairTranslator):
        return translator.between(source, target)
    return translator


def require_masks(
    source: torch.Tensor, target_reference: torch.Tensor, source_reference: torch.Tensor | None
) -> None:
    """Refuse what no translator takes.

    Raises:
        LearningError: Not bool, or not of the size of a mask.
    """
    import torch

    given = {"source": source, "target_reference": target_reference}
    if source_reference is not None:
        given["source_reference"] = source_reference
    for what, masks in given.items():
        due = (len(source), HEIGHT, WIDTH) if what == "source" else (HEIGHT, WIDTH)
        if masks.dtype != torch.bool or tuple(masks.shape) != due:
            shape = ("n", *due[1:]) if what == "source" else due
            raise LearningError(
                f"{what}: found {str(masks.dtype).removeprefix('torch.')} {tuple(masks.shape)}; "
                f"allowed: bool {shape}"
            )


def untouched_source(
    source: torch.Tensor, source_reference: torch.Tensor | None, *, ordered: bool
) -> torch.Tensor:
    """Return the untouched source, bool (480, 640): what is given, or how an ordered press begins.

    Raises:
        LearningError: Neither is known.
    """
    if source_reference is not None:
        return source_reference
    if not ordered:
        raise LearningError(
            "source_reference: missing; allowed: the untouched source, or an ordered press"
        )
    return source[0]
