"""Grid solutions for one to three dimensions, to check everything else against: `reference.solve_reference(problem)`."""
