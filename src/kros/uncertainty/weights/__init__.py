"""Covers of residuals, the weights that bound them at all frequencies, and the proof that they do."""
