"""One column while it is written: sealed shards behind it, one open shard at its end."""

import shutil

from recorder.layout import CHUNKS_PER_SHARD, Layout
from recorder.shard import OpenShard, reopen


class ColumnLog:
    """Appends encoded chunks to a column and seals its shards.

    The array's declared length grows only after a shard is sealed, so whatever a Zarr reader may
    see is there.
    """

    def __init__(self, layout: Layout, chunks: int) -> None:
        """Open the column behind its first `chunks` chunks; what lies behind them is dropped.

        Raises:
            SessionError: The column holds fewer chunks.
        """
        self.layout = layout
        self.chunks = chunks
        self._shard: OpenShard | None = None
        number, held = divmod(chunks, CHUNKS_PER_SHARD)
        for other in layout.shard_numbers():
            if other < number and layout.partial(other).exists():
                self.seal(reopen(layout, other, CHUNKS_PER_SHARD))
            elif other > number:
                layout.partial(other).unlink(missing_ok=True)
        if held:
            self._shard = reopen(layout, number, held)
        else:
            layout.partial(number).unlink(missing_ok=True)

    def append(self, chunk: bytes, t_ns: int) -> None:
        """Add one encoded chunk, whose last sample is from `t_ns`.

        Raises:
            OSError: It could not be written whole; the column is as before.
        """
        if self._shard is None:
            self._shard = OpenShard(self.layout, self.chunks // CHUNKS_PER_SHARD, [])
        self._shard.append(chunk, t_ns)
        self.chunks += 1

    def drop_last(self) -> None:
        """Take back the chunk that was added last."""
        if self._shard is not None and len(self._shard):
            self._shard.drop_last()
            self.chunks -= 1

    def take_full(self) -> OpenShard | None:
        """Hand over the open shard if it is full; the next chunk starts another."""
        if self._shard is None or not self._shard.full:
            return None
        shard, self._shard = self._shard, None
        return shard

    def seal(self, shard: OpenShard) -> None:
        """Seal a full shard of this column, then let the array's length include it."""
        shard.seal()
        rows = (shard.number + 1) * self.layout.rows_per_shard
        self.layout.set_rows(max(rows, self.layout.rows()))

    def seal_full(self) -> None:
        """Seal the open shard if it is full. May be called again after an error."""
        if self._shard is not None and self._shard.full:
            self.seal(self._shard)
            self._shard = None

    def sync(self) -> None:
        """Make what was appended survive a power cut. May be called from another thread."""
        shard = self._shard
        if shard is not None:
            shard.sync()

    def finish(self, rows: int) -> None:
        """Seal the open shard and declare the array to be `rows` long."""
        if self._shard is not None:
            self._shard.seal()
            self._shard = None
        self.layout.set_rows(rows)
        self._remove_behind(-(-rows // self.layout.rows_per_shard))

    def close(self) -> None:
        """Let go of the open shard as it is. Safe twice."""
        if self._shard is not None:
            self._shard.close()
            self._shard = None

    def _remove_behind(self, shards: int) -> None:
        for number in self.layout.shard_numbers():
            if number < shards:
                continue
            self.layout.partial(number).unlink(missing_ok=True)
            self.layout.shard(number).unlink(missing_ok=True)
            if self.layout.column.shape:
                shutil.rmtree(self.layout.path / "c" / str(number))
