"""Runs and their folders: begin, resume, finish and read a run. Imports training and everything below."""
