"""What the bounds of one certificate share: of trained fields, of recorded samples, or of a given controller."""
