"""How often the ego crashes in normal traffic: a model of human errors, a proposal, runs with weights, an estimator."""
