"""Structured perturbations: bounds of the structured singular value, and D-K iteration."""
