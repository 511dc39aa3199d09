"""Makes suites: draws encounters on the shipped networks and keeps those that are calm without an attack."""
