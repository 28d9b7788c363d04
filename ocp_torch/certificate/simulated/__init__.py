"""What a controller costs, and where it goes, by simulation."""
