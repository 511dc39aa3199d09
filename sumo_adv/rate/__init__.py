"""Estimate how often the ego crashes in normal traffic: human errors, a proposal, weighted runs, an estimator."""
