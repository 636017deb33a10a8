"""Sessions: what a stream holds, writing, reading, alignment, windows."""
