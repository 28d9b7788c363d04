"""Mathematics that knows of no problem: derivatives, suprema, integrals, point sets, seeds. Imports `errors` alone."""
