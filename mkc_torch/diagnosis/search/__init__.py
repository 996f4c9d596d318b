"""The search for the strongest candidate and its p-value."""
