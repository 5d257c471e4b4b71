"""Observers for the worst member of an uncertain set, and certificates for any observer."""
