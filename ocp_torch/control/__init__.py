"""Controllers as functions of the state, and as files. Imports objectives and everything below."""
