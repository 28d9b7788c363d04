"""Reading files that a stranger may have written, and writing files that survive a crash. Imports `errors` alone."""
