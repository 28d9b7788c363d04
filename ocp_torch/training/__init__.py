"""Training: the loop, its batches, its evaluations on the way. Knows of no folder but where its checkpoint goes."""
