"""The observer as C99 source and as a functional mock-up unit."""
