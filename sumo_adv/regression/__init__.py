"""Keep found attacks as cases, and rerun them reactively against any driver: ``sumo-adv keep`` and ``regress``."""
