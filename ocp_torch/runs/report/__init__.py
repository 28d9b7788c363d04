"""What a run, or many of them, have to say, as one page to look at. Imports what a run's folder is read with."""
