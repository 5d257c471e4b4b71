"""Figures of units that do not belong to the batch."""
