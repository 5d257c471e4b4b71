"""The nominal model of a population: the best unit or candidate by peak, area or cost."""
