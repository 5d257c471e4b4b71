"""One reader per file; each returns a lazy `Population`."""
