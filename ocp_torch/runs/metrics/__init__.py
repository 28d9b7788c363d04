"""What a practitioner asks of a controller: does it reach, avoid, synchronise; against nothing and against the classics.

`measures` says what is measured on each system, `classical` holds its classical controller, and `trial` runs them all from
the same starts and leaves `metrics.json` in a run's folder.
"""
