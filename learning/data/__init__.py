"""What networks see of marker archives: images, fields, presses in memory, splits, force ranges."""
