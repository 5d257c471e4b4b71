"""Mixed H2/H-infinity synthesis: matrix inequalities, and the interior-point method that solves them."""
