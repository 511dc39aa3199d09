"""The former address of :mod:`sumo_adv.simulation` and :mod:`sumo_adv.drivers`."""
