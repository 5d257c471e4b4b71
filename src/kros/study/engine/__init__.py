"""What carries a study: run folder, records of its stages, executors, progress."""
