"""Search for an attack: draw candidates, predict and score them, and choose the next one to try."""
