"""Network inputs from marker archives: images, fields, presses in memory, splits, force ranges."""
