"""A page to watch a collection on, served by a process of its own that can only look and ask."""
