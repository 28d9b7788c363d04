"""A lower bound proved by interval arithmetic, in one and two dimensions; imported only where one is asked for."""
