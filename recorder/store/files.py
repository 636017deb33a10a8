"""Access to the files of a session, on the local disk or in a remote store behind a URL.

Readers access files through `Files` and name them by `Path`; in a remote store, a path is the key
of an object. `SealedFiles` verifies what is read by the newest manifest of a session. Writers
always write to a disk, by changes that are atomic and durable, also after a power failure.
"""

import ctypes
import errno
import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from recorder.errors import SessionError

# Suffixes of a file and of a folder that is still being written and not yet valid.
TEMPORARY, CREATING = ".tmp", ".creating"

# Offset and length in a file [bytes].
Range = tuple[int, int]


class Files:
    """Read access to files by path: here of the local disk, which its subclasses replace."""

    local = True
    """True if the paths are on this machine."""

    def __init__(self) -> None:
        # zarr.json files read so far, while `remembering`.
        self._documents: dict[Path, bytes] | None = None

    def name(self, path: Path) -> str:
        """Return the path or URL for messages."""
        return str(path)

    def read(self, path: Path) -> bytes:
        """Return a whole file.

        Raises:
            FileNotFoundError: No such file; so do `tail` and `ranges`.
        """
        documents = self._documents
        if documents is None or path.name != "zarr.json":
            return path.read_bytes()
        if path not in documents:
            documents[path] = path.read_bytes()
        return documents[path]

    @contextmanager
    def remembering(self) -> Iterator[None]:
        """Read each zarr.json only once as long as this context lasts."""
        before = self._documents
        self._documents = {} if before is None else before
        try:
            yield
        finally:
            self._documents = before

    def tail(self, path: Path, nbytes: int) -> bytes:
        """Return the last `nbytes` of a file, or all of a shorter one."""
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            return os.pread(file.fileno(), nbytes, max(size - nbytes, 0))

    def ranges(self, path: Path, wanted: Sequence[Range]) -> list[bytes]:
        """Return parts of a file; a part that extends beyond its end is short."""
        fd = os.open(path, os.O_RDONLY)
        try:
            return [os.pread(fd, nbytes, offset) for offset, nbytes in wanted]
        finally:
            os.close(fd)

    def groups(self, path: Path) -> list[Path]:
        """Return the directories directly below a path that contain a `zarr.json`, sorted."""
        return sorted(entry.parent for entry in path.glob("*/zarr.json"))

    def listed(self, path: Path) -> list[Path]:
        """Return all files below a directory."""
        return [entry for entry in path.rglob("*") if entry.is_file()]

    def sizes(self, path: Path) -> dict[Path, int]:
        """Return all files below a directory with their sizes [bytes]."""
        sizes = {}
        for entry in self.listed(path):
            try:
                sizes[entry] = entry.stat().st_size
            except FileNotFoundError:  # sealed or removed in the meantime by a writer
                continue
        return sizes


# The only instance that writers use.
LOCAL = Files()


def is_url(place: str | os.PathLike[str]) -> bool:
    """Return True if a place is a URL, such as `s3://bucket/x.zarr`."""
    return isinstance(place, str) and "://" in place


def locate(
    place: str | os.PathLike[str], storage_options: Mapping[str, Any] | None = None
) -> tuple[Files, Path]:
    """Return the file access for a path or fsspec's URL and options, and the path within it."""
    if is_url(place):
        return open_url(str(place), storage_options or {})
    if storage_options:
        raise SessionError(f"{place}: storage options are for URLs; this is a path")
    return Files(), Path(place)


# Reading from object stores and web servers, through fsspec: `s3://`, `https://`, `memory://` ...
#
# Network traffic is kept low: a shard's index is read once, then the byte ranges of the requested
# chunks. Neighbouring ranges share a request, and requests are concurrent if the store allows it.

# Gap between two ranges up to which fetching it is cheaper than another request [bytes].
_JOIN_GAP = 1 << 14
_HINTS = {
    "NoCredentialsError": "no credentials: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or "
    "storage_options={'anon': True} for a public bucket",
    "PermissionError": "not allowed: wrong credentials, or no read permission",
    "EndpointConnectionError": "no answer from the store's address",
    "ClientConnectorError": "no answer from this address",
}


class RemoteFiles(Files):
    """Files of one remote store; pickled and forked as protocol and options."""

    local = False

    def __init__(self, protocol: str, options: Mapping[str, Any], prefix: str) -> None:
        """Name a store by fsspec's protocol and options, and the part of the URL before a path.

        The options are never printed, since they may contain secrets.
        """
        self.protocol, self.options, self.prefix = protocol, options, prefix
        # zarr.json files: a finished session does not change.
        self._documents: dict[Path, bytes] = {}

    def name(self, path: Path) -> str:
        """Return the URL of a path."""
        return self.prefix + str(path).lstrip("/") if self.prefix else str(path)

    def read(self, path: Path) -> bytes:
        """Return a whole file; metadata is fetched only once."""
        if path in self._documents:
            return self._documents[path]
        with self._said(path):
            data: bytes = self._system().cat_file(self._key(path))
        if path.name == "zarr.json":
            self._documents[path] = data
        return data

    def tail(self, path: Path, nbytes: int) -> bytes:
        """Return the last bytes of a file."""
        with self._said(path):
            data: bytes = self._system().cat_file(self._key(path), start=-nbytes)
        self._check_range(path, data, nbytes)
        return data

    def ranges(self, path: Path, wanted: Sequence[Range]) -> list[bytes]:
        """Return parts of a file: neighbours in one request, the others concurrently."""
        joined = join_ranges(wanted)
        key = self._key(path)
        with self._said(path):
            if len(joined) == 1:
                (start, stop) = joined[0]
                parts = [self._system().cat_file(key, start=start, end=stop)]
            else:
                starts, stops = [r[0] for r in joined], [r[1] for r in joined]
                parts = self._system().cat_ranges(
                    [key] * len(joined), starts, stops, on_error="raise"
                )
        for part, (start, stop) in zip(parts, joined, strict=True):
            self._check_range(path, part, stop - start)
        out = []
        for offset, nbytes in wanted:
            index = next(i for i, (start, stop) in enumerate(joined) if start <= offset < stop)
            first = offset - joined[index][0]
            out.append(bytes(parts[index][first : first + nbytes]))
        return out

    def _check_range(self, path: Path, data: bytes, nbytes: int) -> None:
        if len(data) > nbytes:
            raise SessionError(
                f"{self.name(path)}: asked for {nbytes} bytes of it, got {len(data)}; allowed: a "
                "server of byte ranges, such as nginx or an object store; "
                "`python -m http.server` has none"
            )

    def groups(self, path: Path) -> list[Path]:
        """Return the Zarr nodes directly below a directory."""
        with self._said(path):
            try:
                entries = self._system().ls(self._key(path), detail=False)
            except FileNotFoundError:
                return []
        nodes = [path / PurePosixPath(str(entry).rstrip("/")).name for entry in entries]
        return sorted(node for node in self._with_documents(nodes) if node != path)

    def listed(self, path: Path) -> list[Path]:
        """Return all files below a directory."""
        with self._said(path):
            names = self._system().find(self._key(path))
        return [Path(name.removeprefix(self.prefix)) for name in names]

    def sizes(self, path: Path) -> dict[Path, int]:
        """Return all files below a directory with their sizes."""
        with self._said(path):
            entries = self._system().find(self._key(path), detail=True)
            sizes = {name: entry["size"] for name, entry in entries.items()}
            unknown = [name for name, size in sizes.items() if size is None]
            if unknown:  # a web server's listing has no sizes
                sizes |= zip(unknown, self._system().sizes(unknown), strict=True)
        return {Path(name.removeprefix(self.prefix)): int(size) for name, size in sizes.items()}

    def _with_documents(self, nodes: list[Path]) -> list[Path]:
        """Return the directories that contain a `zarr.json`, fetching all concurrently."""
        keys = {self._key(node / "zarr.json"): node for node in nodes}
        if not keys:
            return []
        with self._said(nodes[0]):
            documents = self._system().cat(list(keys), on_error="return")
            for key, data in documents.items():
                if isinstance(data, bytes):
                    self._documents[keys[key] / "zarr.json"] = data
                elif not isinstance(data, FileNotFoundError | NotADirectoryError):
                    raise data
        return [keys[key] for key, data in documents.items() if isinstance(data, bytes)]

    def _system(self) -> Any:
        # fsspec keeps one instance per set of options, and makes another after a fork.
        return _fsspec().filesystem(self.protocol, **self.options)

    def _key(self, path: Path) -> str:
        # A Path cannot hold the double slash of a web address; keys of other stores have none.
        return self.name(path) if self.protocol in _WEB else str(path)

    @contextmanager
    def _said(self, path: Path) -> Iterator[None]:
        """Turn errors of a store's client into one-line messages; keep FileNotFoundError."""
        try:
            yield
        except (FileNotFoundError, SessionError):
            raise
        except Exception as error:
            # Each store has its own exceptions; this is the only place where they enter.
            message = _HINTS.get(type(error).__name__, f"{type(error).__name__}: {error}")
            raise SessionError(f"{self.name(path)}: {message}") from error


_WEB = ("http", "https")


def open_url(url: str, options: Mapping[str, Any]) -> tuple[RemoteFiles, Path]:
    """Return the store of a URL and the path in it."""
    fsspec = _fsspec()
    protocol = url.partition("://")[0]
    try:
        system = fsspec.filesystem(protocol, **options)
    except (ImportError, ValueError, TypeError) as error:
        raise SessionError(f"{url}: {error}") from error
    if protocol in _WEB:
        host, _, path = url.partition("://")[2].rstrip("/").partition("/")
        return RemoteFiles(protocol, dict(options), f"{protocol}://{host}/"), Path(path)
    key = str(system._strip_protocol(url)).rstrip("/")
    return RemoteFiles(protocol, dict(options), f"{protocol}://"), Path(key)


def join_ranges(wanted: Sequence[Range]) -> list[Range]:
    """Return the fewest ranges that cover all (offset, length); gaps below 16 KiB are joined."""
    joined: list[list[int]] = []
    for offset, nbytes in sorted(wanted):
        if joined and offset <= joined[-1][1] + _JOIN_GAP:
            joined[-1][1] = max(joined[-1][1], offset + nbytes)
        else:
            joined.append([offset, offset + nbytes])
    return [(start, stop) for start, stop in joined]


def _fsspec() -> Any:
    try:
        import fsspec
    except ModuleNotFoundError:
        raise SessionError("remote stores need fsspec: pip install 'tactile-rig[remote]'") from None
    return fsspec


# Files of a session, compared with its manifest (`manifest.py`) when they are read.


@dataclass(frozen=True, slots=True)
class Shard:
    """A sealed shard."""

    size: int
    """Length of the file [bytes]."""
    chunks: int
    """Number of chunks that it holds."""
    slots: int
    """Number of chunks that it can hold."""
    digest: str
    """SHA-256 of its end: the checksums of its chunks, and its index."""

    @property
    def end_bytes(self) -> int:
        """Length of the end [bytes]."""
        return 20 * self.slots + 4


@dataclass(frozen=True, slots=True)
class Manifest:
    """Files of a session at the end of a run; paths are relative to the session."""

    run: int
    previous: dict[str, Any] | None
    """`run` and `sha256` of the manifest before it; None for the first."""
    rows: dict[str, int]
    """Number of rows by stream and table."""
    files: dict[str, tuple[int, str]]
    """Size [bytes] and SHA-256 of every file but the shards of streams."""
    shards: dict[str, Shard]
    digest: str
    """SHA-256 of the file of the manifest itself."""

    @property
    def fixed(self) -> dict[str, Shard]:
        """Shards that no later run may change: the full ones."""
        return {key: shard for key, shard in self.shards.items() if shard.chunks == shard.slots}


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
            entry = (len(data), hashlib.sha256(data).hexdigest())
            if self.manifest.files.get(key) != entry:
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


def sync_directory(path: Path) -> None:
    """Make the names in a directory, or the content of a file, durable.

    Network and FUSE file systems that cannot sync a directory answer EINVAL; they keep names safe
    by themselves, or not at all.
    """
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno != errno.EINVAL or not path.is_dir():
            raise
    finally:
        os.close(fd)


# Flushes a whole file system, in one go; None where the C library cannot.
SYNCFS = getattr(ctypes.CDLL(None), "syncfs", None)


def sync_tree(path: Path) -> None:
    """Make every file and every name below a directory durable."""
    fd = os.open(path, os.O_RDONLY)
    try:
        if SYNCFS is not None and SYNCFS(fd) == 0:
            return
    finally:
        os.close(fd)
    for folder, _, names in os.walk(path, topdown=False):
        for name in names:
            sync_directory(Path(folder, name))
        sync_directory(Path(folder))


def replace_file(path: Path, data: bytes, *, several: bool = False) -> None:
    """Write `data` to `path` atomically: a reader sees the old or the new content.

    `several` writers may write the same file at the same time.
    """
    own = f".{os.getpid()}-{secrets.token_hex(4)}" if several else ""
    temporary = path.with_name(f"{path.name}{own}{TEMPORARY}")
    fd = os.open(temporary, os.O_CREAT | os.O_WRONLY | os.O_TRUNC, 0o644)
    try:
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(fd, rest) :]
        os.fsync(fd)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    finally:
        os.close(fd)
    temporary.replace(path)
    sync_directory(path.parent)


@contextmanager
def building(final: Path) -> Iterator[Path]:
    """Yield the path to build at; on exit, rename it to `final`, or remove it on error.

    An interruption counts as an error, so what is built is either complete or absent.
    """
    if final.exists() or final.is_symlink():
        raise SessionError(f"{final}: exists already; choose another name")
    if not final.parent.is_dir():
        raise SessionError(f"{final.parent}: no such directory")
    beside = final.with_name(final.name + CREATING)
    _remove(beside)
    try:
        yield beside
        beside.rename(final)
        sync_directory(final.parent)
    except BaseException:
        _remove(beside)
        raise


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
