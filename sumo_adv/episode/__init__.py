"""One episode: the search for an encounter, the attempts in closed-loop simulation, their verdicts and the result."""
