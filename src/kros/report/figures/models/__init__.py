"""Figures of the identified models."""
