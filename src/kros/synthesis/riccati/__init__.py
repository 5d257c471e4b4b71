"""Synthesis by Riccati equations: H2, H-infinity, and the constant gains of Kalman and Luenberger."""
