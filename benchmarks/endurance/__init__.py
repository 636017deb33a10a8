"""Long collection on the mock bench, with its memory and dropped samples measured."""
