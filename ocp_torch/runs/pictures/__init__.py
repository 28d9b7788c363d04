"""Pictures of controlled systems: a scene for each, still or moving. Matplotlib is imported where something is drawn."""
