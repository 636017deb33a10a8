"""How bytes lie on the disk: shards that are their own log, journals, columns, durable files."""
