"""The commands, one file each: `main` is what `scripts/<name>.py` and the installed `ocp-<name>` call."""
