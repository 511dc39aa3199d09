"""Found attacks kept as cases, and run again reactively against any driver: ``sumo-adv keep`` and ``regress``."""
