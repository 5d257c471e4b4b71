"""Uncertainty where an observer feels it: left coprime factors, as signals."""
