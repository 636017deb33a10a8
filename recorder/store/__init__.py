"""How bytes lie on the disk: shards that are their own log, journals, columns, durable files."""

from recorder.store.durable import replace_file, sync_directory
from recorder.store.images import decode_jpeg

__all__ = [
    "decode_jpeg",
    "replace_file",
    "sync_directory",
]
