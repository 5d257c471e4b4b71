"""Stages: each reads what earlier ones left in the run folder, calls the packages, and writes into its draft."""
