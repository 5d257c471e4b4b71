"""Simulated motor drives with a Harmonic Drive gearbox, tuned to look like those of section IV.

`parameters` draws the drives, `reference` their trajectories, `dynamics` and `simulation` run them, `population` puts
it together with its `truth`.
"""
