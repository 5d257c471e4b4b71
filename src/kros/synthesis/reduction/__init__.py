"""Controllers of fewer states by balanced truncation."""
