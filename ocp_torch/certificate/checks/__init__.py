"""Checks of what the bounds rest on against what could refute it."""
