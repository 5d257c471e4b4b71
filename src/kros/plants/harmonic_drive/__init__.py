"""Simulated motor drives with a Harmonic Drive gearbox, tuned to look like those of section IV.

`parameters` draws the drives, `reference` their trajectories, `dynamics` runs them, `population` adds their `truth`.
"""
