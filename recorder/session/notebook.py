"""Picture of a session in a notebook."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image

from recorder.errors import SessionError
from recorder.session.columns import Stream

# Number of pictures, and their height [px].
PICTURES, HEIGHT = 4, 96


def html_of(name: str, title: str, warning: str | None, streams: Mapping[str, Stream]) -> str:
    """Return a table of the streams and pictures of the first camera, evenly spread in time.

    Args:
        name: Location of the session.
        title: Status, sensor and indenter.
        warning: Warning to show before the session is used, or None.
        streams: Streams by name.
    """
    rows = "".join(
        f"<tr><td>{html.escape(stream.name)}</td><td>{html.escape(stream.traits.kind)}</td>"
        f"<td style='text-align:right'>{len(stream):,}</td>"
        f"<td style='text-align:right'>{stream.rate_hz:g}</td><td>{_shape(stream)}</td></tr>"
        for stream in streams.values()
    )
    head = "".join(f"<th>{each}</th>" for each in ("stream", "kind", "rows", "Hz", "a row"))
    cameras = [stream for stream in streams.values() if stream.traits.kind == "camera"]
    pictures = "".join(_pictures(cameras[0])) if cameras else ""
    return (
        f"<div><b>{html.escape(name)}</b>: {html.escape(title)}"
        + (f"<br>{html.escape(warning)}" if warning else "")
        + f"<br>{pictures}<table><tr>{head}</tr>{rows}</table></div>"
    )


def _shape(stream: Stream) -> str:
    value = stream.value_column
    shape = stream.layout.image.column.shape if stream.layout.image is not None else ()
    if value is not None:
        shape = value.shape
    return " x ".join(map(str, shape)) or "1"


def _pictures(stream: Stream) -> list[str]:
    """Return images as HTML; none of those that cannot be read."""
    if not len(stream):
        return []
    try:
        images: Any = stream.images(np.linspace(0, len(stream) - 1, PICTURES).astype(np.int64))
    except SessionError as error:
        return [html.escape(f"{error}")]
    tags = []
    for pixels in images:
        grey = pixels.ndim == 2 or pixels.shape[-1] == 1
        picture = Image.fromarray(pixels.reshape(pixels.shape[:2]) if grey else pixels)
        picture = picture.convert("L" if grey else "RGB")
        picture.thumbnail((4 * HEIGHT, HEIGHT))
        jpeg = io.BytesIO()
        picture.save(jpeg, "JPEG", quality=85)
        text = base64.b64encode(jpeg.getvalue()).decode()
        tags.append(f"<img alt='' style='margin:2px' src='data:image/jpeg;base64,{text}'>")
    return tags
