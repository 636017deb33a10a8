"""One process per stream: it owns the device's driver and appends what arrives to its shard log."""
