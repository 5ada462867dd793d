"""From frames to features; knows nothing of bodies."""
