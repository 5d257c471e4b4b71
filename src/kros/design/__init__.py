"""Observer design: from uncertain models to an observer, by any method, with what is certified about it."""
