"""Agents that choose intents and write planners: protocols, prompts, the built-in expert and language models."""
