"""An observer as a functional mock-up unit for co-simulation, from the same C source."""
