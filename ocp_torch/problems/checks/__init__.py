"""A problem is checked once, before anything is trained: `check.check_once`. Each file holds one kind of check."""
