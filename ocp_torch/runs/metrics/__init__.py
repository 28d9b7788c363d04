"""What a practitioner asks of a controller: does it reach, avoid, synchronise; against nothing and against the classics."""
