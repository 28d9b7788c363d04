"""Upper bounds on what a controller costs, without simulation, one a file."""
