"""The command line: nothing else knows of Hydra."""
