"""The units of a population against each other: nominal, spread, noise, every unit's own residual."""
