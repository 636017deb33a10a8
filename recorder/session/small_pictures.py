"""Pictures of a camera at an eighth of their size, which are enough to see a press."""

from collections.abc import Sequence

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from recorder.session.columns import Stream
from recorder.session.reader import Session

Floats = NDArray[np.floating]

# Maps of a picture: grey, red less blue, and green less both, of red, green and blue.
MAPS = np.array([[0.299, 1.0, -0.5], [0.587, 0.0, 1.0], [0.114, -1.0, -0.5]], np.float32)
# Factor by which pictures are made smaller, if that leaves enough pixels along each side; and
# fewest of these.
SMALLER, FEWEST = 8, 8


def small_size(stream: Stream) -> tuple[int, int]:
    """Return height and width of the smaller pictures of a camera."""
    image = stream.layout.image
    height, width = (0, 0) if image is None else image.column.shape[:2]
    factor = SMALLER if min(height, width) >= SMALLER * FEWEST else 1
    return height // factor, width // factor


def smaller(stream: Stream, rows: Sequence[int], broken: dict[int, str]) -> Floats:
    """Return `MAPS` of pictures of a camera, of `small_size` (3, n, h, w).

    Rows that cannot be decoded are added to `broken`, and are as those before them, or NaN.
    """
    height, width = small_size(stream)
    small = np.zeros((3, len(rows), height, width), np.float32)
    if stream.jpeg_shape is None:
        for k, row in enumerate(rows):
            (image,) = stream.images([row])
            factor = len(image) // height
            image = image[: height * factor, : width * factor]
            image = image.reshape(height, factor, width, factor, -1).mean(axis=(1, 3))
            small[:, k] = np.moveaxis(np.broadcast_to(image, (height, width, 3)) @ MAPS, -1, 0)
        return small
    good = 0
    for k, (row, data) in enumerate(zip(rows, stream.jpegs(rows), strict=True)):
        try:
            image = simplejpeg.decode_jpeg(data, "RGB", True, True, height, width)
            small[:, k], good = np.moveaxis(image[:height, :width] @ MAPS, -1, 0), k
        except ValueError as error:
            broken[row] = f"cannot be decoded: {error}"
            small[:, k] = small[:, good] if k else np.nan
    return small


def rms(images: Floats) -> Floats:
    """Return the root of the mean square of each picture (n, h, w)."""
    return np.asarray(np.sqrt((images**2).mean(axis=(1, 2))))


def reference_rows(session: Session, name: str, point: float | None = None) -> list[int]:
    """Return rows of the pictures without contact, above all points or one."""
    column, reference = session.columns.get(name), session.reference
    rows = np.asarray(reference.get(column, ()) if column else (), np.int64)
    rows = rows if point is None else rows[np.asarray(reference["point"])[: len(rows)] == point]
    return [int(row) for row in rows if 0 <= row < len(session.streams[name])]
