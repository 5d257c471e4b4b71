"""Writers of populations: kros's Parquet, and the paper's raw layout; folders appear whole or not at all."""
