"""Bridges to pykoop, scikit-learn and python-control."""
