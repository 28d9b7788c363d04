"""A lower bound proved by interval arithmetic, for networks in one and two dimensions.

Imported only where a proof is asked for. It may import the rest of `certificate` and what is below; what it knows of each
class of problems is in `enclosures`.
"""
