"""Reading untrusted files, and writing files that survive a crash. Imports `errors` alone."""
