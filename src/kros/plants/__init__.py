"""Simulated populations with known truth. Returns populations and truth; writing to disk is `kros.data`'s."""

from .harmonic_drive import HarmonicDrivePopulation

__all__ = ["HarmonicDrivePopulation"]
