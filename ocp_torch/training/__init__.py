"""Training: the loop and what it looks at on the way. Knows of no folder but where its checkpoint goes."""
