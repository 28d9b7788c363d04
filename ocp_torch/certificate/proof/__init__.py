"""Lower bounds by interval arithmetic, for networks in one and two dimensions."""
