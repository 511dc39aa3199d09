"""Language models: client, wire format, budget ledger, recordings and presets."""
