"""A lower bound proved by interval arithmetic, for networks in one and two dimensions.

Nothing outside of this room knows of it, and it is imported only where a proof is asked for. It may import the rest of
`certificate` and what is below; `enclosures` says what it knows of each class of problems.
"""
