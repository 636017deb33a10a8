"""Storage on disk: shards that act as logs, journals, columns and atomic file changes."""

from recorder.store.durable import replace_file, sync_directory
from recorder.store.images import decode_jpeg

__all__ = [
    "decode_jpeg",
    "replace_file",
    "sync_directory",
]
