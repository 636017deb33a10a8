"""One page that shows what an import will write, to be looked at before it is written."""

import base64
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps

from recorder.charts import BLUE, RED
from recorder.convert.import_session import Draft
from recorder.pages import render
from recorder.plot import Curve, line_plot
from recorder.session.align import NS

_SIZE = (900, 240)
# Most recordings that are drawn; the rest is listed.
_DRAWN = 30


def write_page(drafts: Sequence[Draft], path: Path, *, sensor: str, places: str) -> None:
    """Write the page (HTML); `places` says what is known of places and depths.

    Raises:
        OSError: The file is not writable.
    """
    lines = list(dict.fromkeys(line for draft in drafts for line in draft.assumed))
    text = render(
        Path(__file__).parent / "import_page.html",
        sensor=sensor,
        places=places,
        recordings=[_drawn(draft, at < _DRAWN) for at, draft in enumerate(drafts)],
        assumed=lines,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8", errors="backslashreplace")


def _drawn(draft: Draft, is_drawn: bool) -> dict[str, Any]:
    """Return a recording as the template takes it; pictures are PNG as data URIs."""
    tracks = ", ".join(
        f"{track.stream} ({track.source}, {len(track.content.t_ns):,} at "
        f"{track.content.rate_hz:.4g} Hz)"
        for track in draft.take.tracks
    )
    presses = ", ".join(
        f"{NS * press.start_ns:.2f} to {NS * press.end_ns:.2f} s" for press in draft.presses
    )
    return {
        "name": draft.take.name,
        "indenter": draft.indenter,
        "tracks": tracks,
        "presses": presses,
        "lag": str(draft.lag or ""),
        "plot": _plot(draft) if is_drawn else "",
        "pictures": _pictures(draft) if is_drawn else (),
    }


def _plot(draft: Draft) -> str:
    trace = draft.trace
    t_s = np.asarray(trace.t_ns * NS, np.float64)
    touched = np.zeros(len(t_s), np.bool_)
    for press in draft.presses:
        touched |= (trace.t_ns >= press.start_ns) & (trace.t_ns < press.end_ns)
    curves = [
        Curve("all", trace.value, BLUE),
        Curve("presses", np.where(touched, trace.value, np.nan), RED),
    ]
    marks = np.array([NS * press.peak_ns for press in draft.presses[:40]], np.float64)
    return _png(line_plot(_SIZE, t_s, curves, title=trace.name, marks=marks, x_label="s"))


def _pictures(draft: Draft) -> tuple[tuple[str, str], ...]:
    film = draft.take.film
    if film is None:
        return ()
    moments = [("without contact", (draft.no_contact[0] + draft.no_contact[1]) // 2)]
    moments += [(f"press {at}", press.peak_ns) for at, press in enumerate(draft.presses[:4], 1)]
    rows = [int(np.argmin(np.abs(film.t_ns - t_ns))) for _, t_ns in moments]
    drawn: dict[int, str] = {}
    for row, image in enumerate(film.load()):
        if row in rows:
            picture: Any = Image.open(io.BytesIO(image)) if isinstance(image, bytes) else None
            picture = picture or Image.fromarray(np.asarray(image))
            drawn[row] = _png(ImageOps.contain(picture.convert("RGB"), (240, 180)))
        if row >= max(rows):
            break
    return tuple((caption, drawn[row]) for (caption, _), row in zip(moments, rows, strict=True))


def _png(picture: Image.Image) -> str:
    content = io.BytesIO()
    picture.save(content, "PNG")
    return "data:image/png;base64," + base64.b64encode(content.getvalue()).decode()
