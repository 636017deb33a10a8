"""Cost of recording, its losses, and the speed of reading, beside other stores."""
