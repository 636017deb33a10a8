r"""One number for all that a stream holds but its times: equal exactly when the bytes are.

The digest of a stream is the SHA-256 of, for each of its columns in the order of attrs `columns`
apart from the time column: the line `<name> <dtype> <shape of a row>\n`, then the rows in order.
A row of numbers goes in as its little-endian bytes; an image that is stored as JPEG as the number
of its bytes (int64, little-endian) and the bytes; an image stored as pixels as its pixels.

`streams/camera/device_t` is left out: it is a time of the host's clock, as `t_ns` is, or nothing.
"""

import hashlib
from collections.abc import Callable, Mapping

from recorder.reader import Session, Stream

Progress = Callable[[int, int], None]

_LEFT_OUT = {"camera": {"device_t"}}


def stream_digest(stream: Stream, progress: Progress | None = None) -> str:
    """Return the digest of a stream as 64 hexadecimal digits.

    Args:
        stream: The stream; all of it is read.
        progress: Called with the images read and their number.

    Raises:
        SessionError: A chunk is missing or damaged.
    """
    digest = hashlib.sha256()
    for layout in stream.layout.columns:
        column = layout.column
        if layout is stream.layout.time or column.name in _LEFT_OUT.get(stream.name, ()):
            continue
        digest.update(f"{column.name} {column.dtype} {list(column.shape)}\n".encode())
        if not column.is_image:
            digest.update(stream.array(column.name).tobytes())
            continue
        for row in range(len(stream)):
            jpeg = stream.jpeg(row)
            if jpeg is None:
                digest.update(stream.images([row]).tobytes())
            else:
                digest.update(len(jpeg).to_bytes(8, "little"))
                digest.update(jpeg)
            if progress is not None:
                progress(row + 1, len(stream))
    return digest.hexdigest()


def session_digest(digests: Mapping[str, str]) -> str:
    r"""Return one digest of several streams: SHA-256 of the lines `<name> <digest>\n`."""
    lines = "".join(f"{name} {digests[name]}\n" for name in sorted(digests))
    return hashlib.sha256(lines.encode()).hexdigest()


def digests(session: Session, progress: Progress | None = None) -> dict[str, str]:
    """Return the digest of every stream of a session, by name.

    Raises:
        SessionError: A chunk is missing or damaged.
    """
    return {name: stream_digest(stream, progress) for name, stream in session.streams.items()}
