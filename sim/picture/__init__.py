"""Pictures of a result: surface, contact pressure, section and force, drawn with Pillow."""

from __future__ import annotations

from sim.picture.page import draw_page, save_picture, shown_frame

__all__ = ["draw_page", "save_picture", "shown_frame"]
