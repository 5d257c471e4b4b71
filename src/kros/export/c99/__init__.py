"""An observer as C99 source: no heap, no globals that change, the state owned by the caller."""
