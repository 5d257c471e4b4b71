"""Rational magnitudes: the tightest bound of data, alone or several at once."""
