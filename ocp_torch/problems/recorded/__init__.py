"""A problem that is a file of samples, and how such a file is written and read."""
