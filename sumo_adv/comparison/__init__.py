"""Compare two runs, campaigns, benches or regressions over the encounters that both have (``sumo-adv compare``)."""
