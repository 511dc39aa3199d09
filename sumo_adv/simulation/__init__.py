"""Run SUMO: engine process, networks, inputs, scenarios, demand, recordings and playback."""
