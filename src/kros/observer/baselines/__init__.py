"""Estimators to compare with: Kalman gains, extended Kalman filter, filtered difference, a learned estimator."""
