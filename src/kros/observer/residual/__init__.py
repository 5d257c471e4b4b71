"""One-step residuals: what drives an observer's error, and the models of residual-shaped observers."""
