"""Simulated motor drives with a Harmonic Drive gearbox, tuned to look like those of section IV."""
