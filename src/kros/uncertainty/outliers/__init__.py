"""Units that stick out, and how far a good one may."""
