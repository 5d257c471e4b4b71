"""Tuning on recordings in which the hidden states are known: one Gauss-Newton search, derivatives through blocks of the error dynamics."""
