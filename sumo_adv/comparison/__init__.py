"""Two sides over the encounters that both have: runs, campaigns, benches or regressions (``sumo-adv compare``)."""
