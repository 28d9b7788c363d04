"""Certificates of what was not trained here: a given controller, recorded samples."""
