"""Lower bounds on `OPT`, one a file."""
