"""A run's folder: begun, gone on with, finished, read again. Imports training and everything below."""
