"""Storage on disk: shards that act as logs, journals, columns and atomic file changes."""

from typing import TYPE_CHECKING

from recorder.on_demand import imports_on_demand

if TYPE_CHECKING:
    from recorder.store.files import is_url as is_url
    from recorder.store.files import locate as locate
    from recorder.store.files import replace_file as replace_file
    from recorder.store.files import sync_directory as sync_directory
    from recorder.store.images import decode_jpeg as decode_jpeg
    from recorder.store.images import jpeg_segments as jpeg_segments
    from recorder.store.reader import ImageTail as ImageTail
    from recorder.store.reader import open_tail as open_tail

__getattr__, __dir__ = imports_on_demand(__name__, __file__)
