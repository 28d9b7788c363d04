"""Certificates of what was not trained here: a controller somebody brings, recorded samples."""
