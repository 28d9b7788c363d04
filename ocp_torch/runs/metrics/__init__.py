"""Metrics of a controller, such as reaching and avoiding, beside no control and classical controllers."""
