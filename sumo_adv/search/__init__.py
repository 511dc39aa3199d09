"""The search for an attack: candidates, predictions, scores, and which candidate is tried next."""
