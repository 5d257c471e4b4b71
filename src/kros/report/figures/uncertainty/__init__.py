"""Figures of residuals, their bounds and the weights."""
