"""What the bounds rest on, held against what could refute it."""
