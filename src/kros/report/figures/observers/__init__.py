"""Figures of errors and estimates of the observers."""
