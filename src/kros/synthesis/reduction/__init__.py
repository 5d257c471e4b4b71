"""Controllers of fewer states: reduction, and polish of what is left."""
