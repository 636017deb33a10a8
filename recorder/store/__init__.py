"""Storage on disk: shards that act as logs, journals, columns and atomic file changes."""

from recorder.store.files import replace_file, sync_directory
from recorder.store.images import decode_jpeg, jpeg_segments
from recorder.store.reader import ImageTail, open_tail

__all__ = [
    "ImageTail",
    "decode_jpeg",
    "jpeg_segments",
    "open_tail",
    "replace_file",
    "sync_directory",
]
