"""Import of the published GenForce folders.

No file has times: docs/how-to/make-marker-archives.md describes the numbering of frames.
"""
