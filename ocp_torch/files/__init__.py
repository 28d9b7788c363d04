"""Files, read as a stranger's and within limits, and written so that they survive. Imports `errors` alone."""
