"""One file a stage; each reads what earlier ones left in the run folder, calls one function of the packages, and writes what comes out into its draft."""
