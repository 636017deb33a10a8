"""Contact sheets of marker patterns and indenters for the docs."""
