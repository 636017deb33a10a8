"""Files of a session, compared with its manifests when they are read, or all at once."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from recorder.errors import SessionError
from recorder.store.documents import ROWS_MAX
from recorder.store.files import LOCAL, Files, Range
from recorder.store.manifest import (
    GROUP,
    Manifest,
    Shard,
    manifest_path,
    manifest_runs,
    readable_chain,
    run_of,
)


class SealedFiles(Files):
    """Files of a session whose content is verified by its manifest when it is read.

    While a run is open, only the shards that are `fixed` are verified.
    """

    def __init__(self, inner: Files, session: Path, manifest: Manifest, is_open: bool) -> None:
        """Hold the files of a session against a manifest; `is_open` while a run is recorded."""
        super().__init__()
        self.inner, self.session, self.manifest, self.is_open = inner, session, manifest, is_open
        self.local = inner.local

    def name(self, path: Path) -> str:
        """Return the path or URL for messages."""
        return self.inner.name(path)

    def read(self, path: Path) -> bytes:
        """Return a whole file."""
        data = self.inner.read(path)
        key = self._key(path)
        shard = self.manifest.shards.get(key)
        if shard is not None:
            self._verify_shard(path, shard, data[-shard.end_bytes :], len(data))
        elif not self.is_open:
            found = (len(data), hashlib.sha256(data).hexdigest())
            if self.manifest.files.get(key) != found:
                raise self._differs(path)
        return data

    def tail(self, path: Path, nbytes: int) -> bytes:
        """Return the last `nbytes` of a file, or all of a shorter one."""
        data = self.inner.tail(path, nbytes)
        shard = self.manifest.shards.get(self._key(path))
        if shard is not None and nbytes == shard.end_bytes:
            self._verify_shard(path, shard, data, None)
        elif not self.is_open:
            raise self._differs(path)
        return data

    def ranges(self, path: Path, wanted: Sequence[Range]) -> list[bytes]:
        """Return parts of a shard, whose chunks have their own checksums."""
        return self.inner.ranges(path, wanted)

    def groups(self, path: Path) -> list[Path]:
        """Return the directories directly below a path that the manifest gives a `zarr.json`."""
        if self.is_open:
            return self.inner.groups(path)
        keys = (self.session / key for key in self.manifest.files)
        return sorted(
            key.parent for key in keys if key.name == "zarr.json" and key.parent.parent == path
        )

    def listed(self, path: Path) -> list[Path]:
        """Return all files below a directory."""
        return self.inner.listed(path)

    def sizes(self, path: Path) -> dict[Path, int]:
        """Return all files below a directory with their sizes [bytes]."""
        return self.inner.sizes(path)

    def _key(self, path: Path) -> str:
        return str(path.relative_to(self.session))

    def _verify_shard(self, path: Path, shard: Shard, end: bytes, size: int | None) -> None:
        if self.is_open and shard.chunks != shard.slots:
            return
        if hashlib.sha256(end).hexdigest() != shard.digest or size not in (None, shard.size):
            raise self._differs(path)

    def _differs(self, path: Path) -> SessionError:
        run = self.manifest.run
        return SessionError(f"{self.name(path)}: differs from the manifest of run {run}")


def sealed_files(
    files: Files, session: Path, attrs: dict[str, Any], *, unsealed: bool = False
) -> tuple[Files, str | None]:
    """Return the files of a session as its manifest verifies them.

    The files of a session in its first run are returned as they are. `unsealed` accepts that a
    manifest is lost; the second value then says which one.
    """
    run, is_open = run_of(attrs), attrs["status"] == "recording"
    if is_open:
        closed = [each for each in manifest_runs(session) if each < run]
        if not closed:
            return files, None
        run = closed[-1]
    chain, broken = readable_chain(files, session, run)
    if broken is not None and (is_open or not unsealed):
        raise broken
    lost = None if broken is None else str(broken)
    if not chain:
        return files, lost
    sealed = SealedFiles(files, session, chain[0], is_open)
    if is_open:
        return sealed, None
    sealed.read(session / "zarr.json")
    if files.local:
        for message in wrong_sizes(session, sealed.manifest):
            raise SessionError(message)
    return sealed, lost


def wrong_sizes(session: Path, manifest: Manifest) -> Iterator[str]:
    """Yield a message per local file that is missing or whose size differs from the manifest."""
    sizes = {key: size for key, (size, _) in manifest.files.items()}
    for key, size in (sizes | {key: shard.size for key, shard in manifest.shards.items()}).items():
        path = session / key
        try:
            found = path.stat().st_size
        except OSError:
            yield f"{path}: missing; the manifest of run {manifest.run} names it"
            continue
        if found != size:
            yield f"{path}: found {found} bytes, the manifest of run {manifest.run} names {size}"


def wrong_files(files: Files, session: Path, attrs: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield path and message of each file that is missing, added or changed, without reading data.

    For a session in an open run, only the shards of the closed runs are verified.
    """
    present = {str(path.relative_to(session)) for path in files.listed(session)}
    run, is_open = run_of(attrs), attrs["status"] == "recording"
    if is_open:
        found = (re.fullmatch(rf"{GROUP}/(\d+)/zarr.json", key) for key in present)
        closed = [int(match[1]) for match in found if match and int(match[1]) < run]
        if not closed:
            return
        run = max(closed)
    chain, broken = readable_chain(files, session, run)
    if broken is not None:
        yield GROUP, str(broken)
    if not chain:
        return
    sealed = SealedFiles(files, session, chain[0], is_open)
    for key in sorted([] if is_open else chain[0].files):
        try:
            sealed.read(session / key)
        except FileNotFoundError:
            yield key, "missing"
        except (SessionError, OSError) as error:
            yield key, str(error)
    sizes = files.sizes(session)
    for key, shard in sorted((chain[0].fixed if is_open else chain[0].shards).items()):
        try:
            sealed.tail(session / key, shard.end_bytes)
        except FileNotFoundError:
            yield key, "missing"
        except (SessionError, OSError) as error:
            yield key, str(error)
        else:
            size = sizes.get(session / key)
            if size != shard.size:
                yield key, f"found {size} bytes, expected {shard.size}"
    for later, earlier in pairwise(chain):
        for key, shard in earlier.fixed.items():
            if later.shards.get(key) != shard:
                yield key, f"run {later.run} changed a full shard of run {earlier.run}"
        for name, rows in earlier.rows.items():
            if not rows <= later.rows.get(name, -1) <= ROWS_MAX:
                yield name, f"run {later.run} removed rows of run {earlier.run}"
    if is_open:
        return
    manifests = {str(manifest_path(session, one.run).relative_to(session)) for one in chain}
    for key in sorted(present - {*chain[0].files, *chain[0].shards} - manifests):
        if broken is not None and key.startswith(f"{GROUP}/"):
            continue
        yield key, f"added after run {run}: the manifest does not name it"


def hold(session: Path, attrs: dict[str, Any]) -> None:
    """Hold a local session against its manifests."""
    for key, message in wrong_files(LOCAL, session, attrs):
        raise SessionError(f"{session / key}: {message}")
