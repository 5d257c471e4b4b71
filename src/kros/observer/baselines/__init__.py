"""Estimators to compare with: Kalman and Luenberger gains, extended Kalman filter, filtered difference, a learned estimator."""
