"""Manifests: every file of a session at the end of a run, with its digest.

The manifest of run k is the attributes of the Zarr group `manifest/<k>`, so that every Zarr reader
can list it. It names the digest of the manifest before it; its last entry is its own digest. A
shard is identified by its end, which lists the checksums of its chunks, and any other file by its
content. `SealedFiles` verifies what is read of a session by its newest manifest.
"""

import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import astuple
from itertools import pairwise
from pathlib import Path
from typing import Any

from recorder.errors import SessionError
from recorder.store import documents
from recorder.store.files import (
    LOCAL,
    TEMPORARY,
    Files,
    Manifest,
    SealedFiles,
    Shard,
    replace_file,
    sync_tree,
)
from recorder.store.layout import MISSING, PARTIAL, StreamLayout

GROUP = "manifest"
# Files that sealing writes again, or leaves behind if it is killed.
_AGAIN = re.compile(rf"zarr\.json|frames.*|{GROUP}/zarr\.json|.*{re.escape(TEMPORARY)}")
_END = b'"sha256": ""}}'


def manifest_path(session: Path, run: int) -> Path:
    """Return the file of the manifest of a run."""
    return session / GROUP / str(run) / "zarr.json"


def manifest_runs(session: Path) -> list[int]:
    """Return the numbers of the runs that have a manifest, in order; local sessions only."""
    names = (path.parent.name for path in (session / GROUP).glob("*/zarr.json"))
    return sorted(int(name) for name in names if name.isdecimal())


def read_manifest(files: Files, session: Path, run: int) -> Manifest:
    """Return the manifest of a run."""
    path = manifest_path(session, run)
    name = files.name(path)
    try:
        documents.check_document_size(files, path)
        data = files.read(path)
    except FileNotFoundError:
        raise SessionError(
            f"{name}: missing, so run {run} cannot be verified (if nothing else is lost, "
            "tactile session recover makes it again)"
        ) from None
    stated = data[-67:-3]
    body = data[:-67] + data[-3:]
    own = hashlib.sha256(body).hexdigest()
    if not body.endswith(_END) or stated != own.encode():
        raise SessionError(f"{name}: changed after it was written")
    attrs = documents.read_document(files, path)["attributes"]
    try:
        manifest = Manifest(
            attrs["run"],
            attrs["previous"],
            attrs["rows"],
            {key: (size, digest) for key, (size, digest) in attrs["files"].items()},
            {key: Shard(*entry) for key, entry in attrs["shards"].items()},
            hashlib.sha256(data).hexdigest(),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise SessionError(f"{name}: not a manifest: {error!r}") from error
    keys = [*manifest.files, *manifest.shards]
    if manifest.run != run or any(key.startswith("/") or ".." in key.split("/") for key in keys):
        raise SessionError(f"{name}: not the manifest of run {run}")
    return manifest


def readable_chain(
    files: Files, session: Path, run: int
) -> tuple[list[Manifest], SessionError | None]:
    """Return manifests of a run and those before, up to one that is unreadable, and which."""
    chain: list[Manifest] = []
    try:
        chain.append(read_manifest(files, session, run))
        while (previous := chain[-1].previous) is not None:
            earlier = read_manifest(files, session, int(previous["run"]))
            name = files.name(manifest_path(session, earlier.run))
            if earlier.run >= chain[-1].run or earlier.digest != previous["sha256"]:
                raise SessionError(f"{name}: not the manifest that run {chain[-1].run} names")
            chain.append(earlier)
    except SessionError as error:
        return chain, error
    return chain, None


def remove_unfinished(session: Path) -> None:
    """Delete the attributes that a killed program had not finished writing."""
    path = session / "zarr.json"
    path.with_name(path.name + TEMPORARY).unlink(missing_ok=True)


def reopen(session: Path, status: str, **attrs: Any) -> None:
    """Open a closed session so that it can be sealed again, and merge into its attributes.

    Its status is kept beside `recording`: if killed before `seal`, `recover` restores it.
    """
    documents.merge_attrs(session, {**attrs, "status": "recording", documents.REBUILDING: status})


def seal(session: Path, **attrs: Any) -> None:
    """Write the manifest of the last run, then merge into the session's attributes.

    The streams must be closed. If killed, the session is as before, and the call can be repeated.
    """
    path = session / "zarr.json"
    remove_unfinished(session)
    document = documents.read_document(LOCAL, path)
    document["attributes"] = {**document["attributes"], **attrs}
    document["attributes"].pop(documents.REBUILDING, None)
    data = documents.json_bytes(path, document)
    write_manifest(session, run_of(document["attributes"]), data)
    replace_file(path, data)


def write_manifest(session: Path, run: int, root: bytes) -> None:
    """Write the manifest of a session whose streams are closed; `run` is its last one.

    `root` is the content that the session's own `zarr.json` has when it is closed.
    """
    manifest_path(session, run).parent.mkdir(parents=True, exist_ok=True)
    earlier = [number for number in manifest_runs(session) if number < run]
    before = read_manifest(LOCAL, session, earlier[-1]) if earlier else None
    if not (session / GROUP / "zarr.json").exists():
        documents.write_group(session / GROUP, {})
    # No power failure may take away what the manifest names.
    sync_tree(session)
    # Of shards that no later run may change, the first digest holds.
    shards = {} if before is None else before.fixed
    rows = {}
    for group in stream_groups(session):
        layout = StreamLayout.load(group)
        rows[str(group.relative_to(session))] = layout.time.rows()
        for column in layout.columns:
            for number in range(-(-column.rows() // column.rows_per_shard)):
                path = column.shard(number)
                key = str(path.relative_to(session))
                if key in shards:
                    continue
                ranges = column.index(number).ranges
                held, slots = sum(offset != MISSING for offset, _ in ranges), len(ranges)
                digest = hashlib.sha256(column.files.tail(path, column.end_bytes)).hexdigest()
                shards[key] = Shard(path.stat().st_size, held, slots, digest)
    files = {}
    for path in sorted(session.rglob("*")):
        key = str(path.relative_to(session))
        if key in shards or not path.is_file() or re.fullmatch(rf"{GROUP}/\d+/.*", key):
            continue
        data = root if key == "zarr.json" else path.read_bytes()
        files[key] = [len(data), hashlib.sha256(data).hexdigest()]
    attrs = {
        "run": run,
        "previous": before and {"run": before.run, "sha256": before.digest},
        "rows": rows,
        "files": files,
        "shards": {key: list(astuple(shard)) for key, shard in shards.items()},
        "sha256": "",
    }
    document = {"zarr_format": 3, "node_type": "group", "attributes": attrs}
    body = json.dumps(document).encode()
    own = hashlib.sha256(body).hexdigest().encode()
    replace_file(manifest_path(session, run), body[:-3] + own + body[-3:])


def stream_groups(session: Path) -> list[Path]:
    """Return the groups of a local session's streams, then of its tables that are streams."""
    groups = sorted(entry.parent for entry in (session / "streams").glob("*/zarr.json"))
    return [*groups, session / "segments", session / "reference"]


def run_of(attrs: dict[str, Any]) -> int:
    """Return the number of the last run in a session's attributes; 0 without a run."""
    return max(len(attrs["runs"]) - 1, 0)


# Sessions as their manifests verify them: what a reader opens, and all files at once.


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
            nbytes = path.stat().st_size
        except OSError:
            yield f"{path}: missing; the manifest of run {manifest.run} names it"
            continue
        if nbytes != size:
            yield f"{path}: found {nbytes} bytes, the manifest of run {manifest.run} names {size}"


def wrong_files(files: Files, session: Path, attrs: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield path and message of each file that is missing, added or changed, without reading data.

    For a session in an open run, the shards of the closed runs are verified, and that its streams
    are its own. If that run has a manifest, it was sealed, and its status is not what was sealed:
    all but the files that sealing writes again is verified, unless a stream is being written.
    """
    present = {str(path.relative_to(session)) for path in files.listed(session)}
    run, unsealed = run_of(attrs), attrs["status"] == "recording"
    is_open = unsealed
    if is_open:
        matches = (re.fullmatch(rf"{GROUP}/(\d+)/zarr.json", key) for key in present)
        closed = [int(match[1]) for match in matches if match and int(match[1]) <= run]
        yield from _foreign(files, session, attrs)
        written = any("journal-" in key or PARTIAL in key for key in present)
        if not closed or (max(closed) == run and written):
            closed = [each for each in closed if each < run]
        if not closed:
            return
        is_open, run = max(closed) < run, max(closed)
    chain, broken = readable_chain(files, session, run)
    if broken is not None:
        yield GROUP, str(broken)
    if not chain:
        return
    sealed = SealedFiles(files, session, chain[0], is_open)
    for key in sorted([] if is_open else chain[0].files):
        if unsealed and _AGAIN.fullmatch(key):
            continue
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
            if not rows <= later.rows.get(name, -1) <= documents.ROWS_MAX:
                yield name, f"run {later.run} removed rows of run {earlier.run}"
    if is_open:
        return
    manifests = {str(manifest_path(session, one.run).relative_to(session)) for one in chain}
    for key in sorted(present - {*chain[0].files, *chain[0].shards} - manifests):
        if (unsealed and _AGAIN.fullmatch(key)) or (
            broken is not None and key.startswith(f"{GROUP}/")
        ):
            continue
        yield key, f"added after run {run}: the manifest does not name it"


def _foreign(files: Files, session: Path, attrs: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the streams that neither the session nor a run of it declares."""
    try:
        own = {*documents.read_order(session / "streams", files)}.union(
            *(run["first_row"] for run in attrs["runs"])
        )
    except SessionError:  # of damaged metadata, which is named elsewhere
        return
    for group in files.groups(session / "streams"):
        if group.name not in own:
            yield f"streams/{group.name}", "the session does not declare this stream"


def hold(session: Path, attrs: dict[str, Any]) -> None:
    """Hold a local session against its manifests."""
    for key, message in wrong_files(LOCAL, session, attrs):
        raise SessionError(f"{session / key}: {message}")
