"""From words to a judged attack: what a request means, scenarios from words, and whether an attack fits its request."""
