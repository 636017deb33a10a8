"""One number for what an archive says of itself and of its frames, without reading them all."""

from __future__ import annotations

import hashlib
import json

from recorder import MarkerArchive
from recorder.archive import COLUMNS


def archive_fingerprint(archive: MarkerArchive) -> str:
    """Return the SHA-256 of attributes, tables, provenance and references, 64 hexadecimal digits.

    Masks and fields are left out: there are gigabytes of them, and whoever makes others says so in
    the attributes or in the lines of provenance.

    Raises:
        SessionError: The archive is still being written, or a table is damaged.
    """
    digest = hashlib.sha256()
    digest.update(json.dumps(archive.attrs, sort_keys=True).encode())
    for name, sensor in archive.items():
        digest.update(f"\n{name} {len(sensor)}\n".encode())
        digest.update(json.dumps(sensor.attrs, sort_keys=True).encode())
        for column in COLUMNS:
            values = sensor.table[column]
            digest.update(f"\n{column} {values.dtype.str} {values.shape}\n".encode())
            digest.update(values.tobytes())
        digest.update("\n".join(sensor.sources).encode())
        digest.update(sensor.references.tobytes())
    return digest.hexdigest()
