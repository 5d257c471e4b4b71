"""Filters shaped by the one-step residuals that were measured."""
