"""Collect a whole session: preflight, the plan move by move, an orderly end whatever happens."""
