"""What a network is shown of a mask, frame after frame: its image, or its marker field."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from learning.data.images import shrink
from learning.errors import LearningError
from learning.force.stream import ForceStream
from learning.translation.flow import MAP_SIDE, FieldReader
from recorder.markers import pack

Mask = NDArray[np.bool_]


class Shown(Protocol):
    """Makes of masks what a network takes."""

    @property
    def reference(self) -> NDArray[np.uint8] | None:
        """The image of the untouched sensor, for a network that takes images."""

    def of(self, mask: Mask) -> NDArray[Any]:
        """Return what is shown of the next mask (480, 640)."""

    def restart(self) -> None:
        """Forget the frames before: the next is untouched."""


def shown_to(network: ForceStream, reference: Mask) -> Shown:
    """Return what makes of masks what a network takes.

    Args:
        network: The force model.
        reference: The untouched mask (480, 640).

    Raises:
        LearningError: A network of another input, or a reference without markers.
    """
    shape = network.inputs.frame[1:]
    if network.inputs.is_image:
        return Images(reference)
    if shape != (3, MAP_SIDE, MAP_SIDE):
        raise LearningError(
            f"model: takes frames {shape}; allowed: images, or marker fields (3, {MAP_SIDE}, "
            f"{MAP_SIDE})"
        )
    return Fields(reference)


class Images:
    """Images of 256 x 256, as training data have them."""

    def __init__(self, reference: Mask) -> None:
        """Take the untouched mask (480, 640)."""
        self.reference: NDArray[np.uint8] | None = self.of(reference)

    def of(self, mask: Mask) -> NDArray[np.uint8]:
        """Return the image (256, 256) of a mask (480, 640)."""
        (image,) = shrink(pack(mask)[None])
        return np.asarray(image, np.uint8)

    def restart(self) -> None:
        """An image does not depend on the one before."""


class Fields(FieldReader):
    """Marker fields (3, 32, 32), whose markers are followed from frame to frame."""

    reference: NDArray[np.uint8] | None = None

    def of(self, mask: Mask) -> NDArray[np.float32]:
        """Return displacement [px] and growth (3, 32, 32) of the next mask (480, 640)."""
        match = self._matcher.step(mask)
        values = np.concatenate([match.moved, match.growth[:, None]], axis=1)
        field = (self._map_operator @ values).T.reshape(3, MAP_SIDE, MAP_SIDE)
        return np.ascontiguousarray(field, np.float32)

    def restart(self) -> None:
        """Expect the next mask to look like the reference."""
        self._matcher.restart()
