"""Mixed H2/H-infinity synthesis: matrix inequalities and their solver."""
