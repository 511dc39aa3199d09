"""Makes suites: draws encounters on the shipped networks and keeps those that are calm while nobody attacks."""
