"""What people would use instead: Kalman and Luenberger gains, extended Kalman filter, filtered difference, a learned estimator."""
