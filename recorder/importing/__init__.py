"""Recordings made elsewhere, wrapped into sessions."""

from recorder.importing.sources import ImportOrder
from recorder.importing.wrap import import_session

__all__ = ["ImportOrder", "import_session"]
