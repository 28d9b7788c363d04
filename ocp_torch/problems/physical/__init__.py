"""Problems in physical units: coordinates with names and units, from which the problem on the torus is made."""
