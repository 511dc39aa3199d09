"""Language models: HTTP client, budget, recordings, and questions with answers of a given type."""
