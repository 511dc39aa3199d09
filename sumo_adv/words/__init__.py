"""From words to a judged attack: read a request, write a scenario for it, and check whether an attack fits it."""
