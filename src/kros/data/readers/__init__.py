"""One reader per file; each returns a lazy `Population`. `read` takes one by name."""
