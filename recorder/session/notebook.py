"""Picture of a session in a notebook."""

from __future__ import annotations

import base64
import html
import io
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from recorder.errors import SessionError

if TYPE_CHECKING:
    from recorder.session.reader import Session, Stream

# Number of pictures, and their height [px].
PICTURES, HEIGHT = 4, 96


def html_of(session: Session) -> str:
    """Return a table of the streams and pictures of the first camera, evenly spread in time."""
    rows = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{html.escape(stream.traits.kind)}</td>"
        f"<td style='text-align:right'>{len(stream):,}</td>"
        f"<td style='text-align:right'>{stream.rate_hz:g}</td><td>{_shape(stream)}</td></tr>"
        for name, stream in session.streams.items()
    )
    head = "".join(f"<th>{each}</th>" for each in ("stream", "kind", "rows", "Hz", "a row"))
    camera = session.first("camera")
    shown = "" if camera is None else "".join(_pictures(session.streams[camera]))
    known = [session.status, *(session.attrs.get(key) for key in ("sensor", "indenter"))]
    told = ", ".join(html.escape(str(each)) for each in known if each)
    warning = session.warning
    return (
        f"<div><b>{html.escape(session.name)}</b>: {told}"
        + (f"<br>{html.escape(warning)}" if warning else "")
        + f"<br>{shown}<table><tr>{head}</tr>{rows}</table></div>"
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
    found = []
    for pixels in images:
        grey = pixels.ndim == 2 or pixels.shape[-1] == 1
        picture = Image.fromarray(pixels.reshape(pixels.shape[:2]) if grey else pixels)
        picture = picture.convert("L" if grey else "RGB")
        picture.thumbnail((4 * HEIGHT, HEIGHT))
        held = io.BytesIO()
        picture.save(held, "JPEG", quality=85)
        text = base64.b64encode(held.getvalue()).decode()
        found.append(f"<img alt='' style='margin:2px' src='data:image/jpeg;base64,{text}'>")
    return found
