"""Means of samples, how sure they are, and what few samples carry."""
