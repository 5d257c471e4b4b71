"""Figures of correction filters and what is certified about them."""
