"""Hard cases nobody chose: scenes drawn by chance, and a referee that is not the solver."""
