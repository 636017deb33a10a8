"""What recording costs, what it loses, and how fast recordings are read, beside other stores."""
