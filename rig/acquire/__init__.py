"""Collection of a session: preflight, the plan move by move, an orderly end after any error."""
